"""Turn cameras, models and features by quarter turns of their pictures.

slimsfm sees photos upright, COLMAP sees their pixels as they are stored. Where the EXIF orientation of a
photo is a rotation, the camera of one is that of the other, turned about its optical axis, so that a model of
one becomes a model of the other without loss. EXIF orientations that mirror have no such camera.

All turns are clockwise turns of the picture: one takes pixel (x, y) of a picture of height H to (H - y, x).
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import ModelError
from slimsfm.features import Features
from slimsfm.mapping.map import Map
from slimsfm.mapping.model import camera_of, positions

_TURNS_TO_STORED = {1: 0, 3: 2, 6: 3, 8: 1}  # of the upright picture, by EXIF orientation

_UNCHANGED = {"f", "k", "k0", "k1", "k2", "k3", "k4", "k5", "k6", "omega", "alpha", "beta"}

# Of a parameter after a quarter turn: the parameter that it comes from, and its sign. `p1, p2` and `sx1, sy1`
# belong to OPENCV, FULL_OPENCV and THIN_PRISM_FISHEYE; `p0, p1` and `s0..s3` to RAD_TAN_THIN_PRISM_FISHEYE.
_TURNED: dict[str, tuple[str, int]] = {name: (name, 1) for name in _UNCHANGED} | {
    "fx": ("fy", 1),
    "fy": ("fx", 1),
    "cy": ("cx", 1),
}
_OPENCV = {"p1": ("p2", 1), "p2": ("p1", -1), "sx1": ("sy1", -1), "sy1": ("sx1", 1)}
_RAD_TAN = {
    "p0": ("p1", -1),
    "p1": ("p0", 1),
    "s0": ("s2", -1),
    "s1": ("s3", -1),
    "s2": ("s0", 1),
    "s3": ("s1", 1),
}


def turns_between(orientation: int, other: int) -> int | None:
    """Turns from an upright picture to another taken with the camera held differently.

    Args:
        orientation: EXIF orientation of the picture.
        other: That of the other one.

    Returns:
        From 0 to 3, so that the camera is the turned camera; None if one of the pictures is mirrored.
    """
    if orientation not in _TURNS_TO_STORED or other not in _TURNS_TO_STORED:
        return None
    return (_TURNS_TO_STORED[orientation] - _TURNS_TO_STORED[other]) % 4


def turned_camera(camera: pycolmap.Camera, turns: int) -> pycolmap.Camera:
    """The camera of a picture that is turned.

    Raises:
        ModelError: The camera model has a parameter whose turn is not known.
    """
    turned = pycolmap.Camera(camera.todict())
    for _ in range(turns % 4):
        turned.params = _quarter_turn(turned)
        turned.width, turned.height = turned.height, turned.width
    return turned


def _quarter_turn(camera: pycolmap.Camera) -> list[float]:
    names = [name.strip() for name in camera.params_info.split(",")]
    before = dict(zip(names, camera.params.tolist(), strict=True))
    rules = _TURNED | (_RAD_TAN if "p0" in before else _OPENCV)
    unknown = [name for name in names if name != "cx" and (name not in rules or rules[name][0] not in before)]
    if unknown or "cx" not in before:
        raise ModelError(
            f"camera {camera.camera_id} ({camera.model_name}) cannot be turned; undistort the images to "
            "PINHOLE cameras first"
        )
    after = {name: rules[name][1] * before[rules[name][0]] for name in names if name != "cx"}
    after["cx"] = camera.height - before["cy"]
    return [after[name] for name in names]


def turned_pixels(
    points2D: Float64[np.ndarray, "n 2"], size: tuple[int, int], turns: int
) -> Float64[np.ndarray, "n 2"]:
    """Where pixels of a picture of this width and height are after turns."""
    for _ in range(turns % 4):
        points2D = np.stack([size[1] - points2D[:, 1], points2D[:, 0]], axis=1)
        size = size[1], size[0]
    return points2D


def turned_pose(cam_from_world: pycolmap.Rigid3d, turns: int) -> pycolmap.Rigid3d:
    """The pose of the camera of a picture that is turned."""
    sine, cosine = (0, 1, 0, -1)[turns % 4], (1, 0, -1, 0)[turns % 4]
    turn = pycolmap.Rotation3d(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float64))
    return pycolmap.Rigid3d(turn, np.zeros(3)) * cam_from_world if turns % 4 else cam_from_world


def turned_features(features: Features, turns: int) -> Features:
    """The features of a picture that is turned; its descriptors stay as they are."""
    if turns % 4 == 0:
        return features
    size, frames = features.image_size, features.frames
    if frames is not None:
        frames = np.stack([frames[:, 0], _wrapped(frames[:, 1] + np.pi / 2 * turns)], axis=1)
    return replace(
        features,
        keypoints=turned_pixels(features.keypoints.astype(np.float64), size, turns).astype(np.float32),
        frames=None if frames is None else frames.astype(np.float32),
        image_size=(size[1], size[0]) if turns % 2 else size,
    )


class TurnedFeatures(Mapping[str, Features]):
    """Features by name of image, those of some images turned on access."""

    def __init__(self, features: Mapping[str, Features], turns: Mapping[str, int]) -> None:
        self._features, self._turns = features, turns

    def __getitem__(self, name: str) -> Features:
        return turned_features(self._features[name], self._turns.get(name, 0))

    def __iter__(self) -> Iterator[str]:
        return iter(self._features)

    def __len__(self) -> int:
        return len(self._features)


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.remainder(angles + np.pi, 2 * np.pi) - np.pi


def turned_model(model: pycolmap.Reconstruction, turns: Mapping[str, int]) -> pycolmap.Reconstruction:
    """A model of turned pictures, with the same ids of images and points.

    A camera keeps its id unless it has to become two; a new one gets the next free id.

    Args:
        model: The model; each image is a frame of its own.
        turns: Turns by name of image. Images that are not named are left out, with the points that only they
            observe.

    Raises:
        ModelError: A camera cannot be turned, or several cameras belong to one rig.
    """
    posed = [model.image(image_id) for image_id in model.reg_image_ids()]
    if not any(turns.values()) and all(image.name in turns for image in posed):
        return model
    if any(rig.num_sensors() > 1 for rig in model.rigs.values()):
        raise ModelError("the model has rigs of several cameras, whose images cannot be turned one by one")
    kept = [image for image in posed if image.name in turns]
    made = pycolmap.Reconstruction()
    camera_ids = _add_cameras(made, model, kept, turns)
    for image in sorted(kept, key=lambda one: one.image_id):
        camera, turn = camera_of(image), turns[image.name]
        copy = pycolmap.Image(
            name=image.name,
            keypoints=turned_pixels(positions(image), (camera.width, camera.height), turn),
            camera_id=camera_ids[image.image_id],
            image_id=image.image_id,
        )
        made.add_image_with_trivial_frame(copy, turned_pose(image.cam_from_world(), turn))
    _copy_points(model, made)
    return made


def _add_cameras(
    made: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    images: list[pycolmap.Image],
    turns: Mapping[str, int],
) -> dict[int, int]:
    """Add the turned cameras of images, those that do not turn first; return their ids by image id."""
    equal, found = {}, {}
    for image in sorted(images, key=lambda one: (turns[one.name] % 4 > 0, one.image_id)):
        camera, has_turned = turned_camera(camera_of(image), turns[image.name]), turns[image.name] % 4 > 0
        key = (camera.model_name, camera.width, camera.height, camera.params.tobytes())
        if has_turned and key in equal:
            camera.camera_id = equal[key]
        elif has_turned and camera.camera_id in made.cameras:
            camera.camera_id = max((*model.cameras, *made.cameras)) + 1
        if camera.camera_id not in made.cameras:
            made.add_camera_with_trivial_rig(camera)
        equal.setdefault(key, camera.camera_id)
        found[image.image_id] = camera.camera_id
    return found


def _copy_points(model: pycolmap.Reconstruction, made: pycolmap.Reconstruction) -> None:
    for point3D_id, point in model.points3D.items():
        track = [one for one in point.track.elements if one.image_id in made.images]
        if track or not point.track.length():  # points for direct matching have no tracks
            copy = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
            copy.track = pycolmap.Track(track)
            made.add_point3D_with_id(point3D_id, copy)


def turns_to_stored(map: Map) -> dict[str, int]:
    """Turns from the pictures of a map to the stored pixels, by name of image; without mirrored images."""
    if map.info.orientation == "stored":
        return dict.fromkeys(map.images, 0)
    tags = {name: map.info.exif_orientations.get(name, 1) for name in map.images}
    return {name: _TURNS_TO_STORED[tag] for name, tag in tags.items() if tag in _TURNS_TO_STORED}


def mirrored_images(map: Map) -> list[str]:
    """The images of a map of upright pictures whose stored pixels are mirrored."""
    return sorted(map.images.keys() - turns_to_stored(map).keys())


def stored_model(map: Map) -> pycolmap.Reconstruction:
    """The model of a map in the pixels of its image files as they are stored, without mirrored images.

    Raises:
        ModelError: All images are mirrored, or the model cannot be turned.
    """
    turns = turns_to_stored(map)
    if not turns:
        raise ModelError("the EXIF orientation of all images mirrors them; store the photos upright")
    return turned_model(map.model, turns)
