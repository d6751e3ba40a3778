"""Read COLMAP models and check them; read or estimate the box of the object.

Damage that pycolmap does not notice is searched for in its bytes (`mapping.binary`) and in the model that it
returns.
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Ids, Points2D, Points3D
from slimsfm.errors import ModelError
from slimsfm.files import contents_of, read_json, read_text
from slimsfm.geometry import Box
from slimsfm.lenses import camera_fault
from slimsfm.mapping.binary import MODEL_PARTS, check_binary
from slimsfm.mapping.extent import distance_fault, extent_fault
from slimsfm.mapping.text import read_text_model

_SHORTEST, _UNIT = 1e-9, 1e-9  # length of a quaternion, and how far from 1 it may be
_AGAIN = "; export the model again"


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, with or without rigs and frames.

    Raises:
        ModelError: The folder holds no model, or the model is damaged.
    """
    suffix = next((s for s in (".bin", ".txt") if (path / f"cameras{s}").is_file()), None)
    if suffix is None:
        raise ModelError(f"{path}: no COLMAP model here (no cameras.bin or cameras.txt)")
    for part in ("images", "points3D"):
        if not (path / f"{part}{suffix}").is_file():
            raise ModelError(
                f"{path / part}{suffix}: missing; a COLMAP model has cameras, images and points3D"
            )
    if suffix == ".bin":
        for part in MODEL_PARTS:
            check_binary(path / f"{part}.bin")
    try:
        model = _read_binary(path) if suffix == ".bin" else read_text_model(path)
        _normalize_rotations(model)
        fault = _fault(model)
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise ModelError(f"{path}: pycolmap cannot read this model: {_first_line(error)}") from error
    if fault:
        raise ModelError(f"{path}: {fault}")
    return model


def _read_binary(path: Path) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.read_binary(path)
    return model


def _normalize_rotations(model: pycolmap.Reconstruction) -> None:
    """Scale quaternions to unit length, which COLMAP's format does not ask for."""
    for frame in model.frames.values():
        if frame.has_pose():
            rotation = frame.rig_from_world.rotation
            length = float(np.linalg.norm(rotation.quat))
            if _SHORTEST < length < np.inf and abs(length - 1) > _UNIT:
                rotation.normalize()


def _fault(model: pycolmap.Reconstruction) -> str | None:
    """The first fault found in a model that pycolmap could read, or None."""
    if not model.num_reg_images():
        return "the model has no image with a pose; give a model with poses"
    if fault := _camera_fault(model):
        return fault
    if not model.is_valid() or _num_track_elements(model) != model.compute_num_observations():
        return f"its points and images do not belong together{_AGAIN}"
    if len({image.name for image in model.images.values()}) < model.num_images():
        return f"several of its images have the same name{_AGAIN}"
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    poses = [image.cam_from_world().matrix() for image in images]
    positions = np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
    if not np.isfinite(poses).all() or not np.isfinite(positions).all():
        return f"a pose or a point in it is not finite{_AGAIN}"
    cameras = np.array([pose[:, 3] for pose in poses])
    if fault := distance_fault("cameras", cameras) or extent_fault("points", positions):
        return f"{fault}{_AGAIN}"
    for image in images:
        if abs(np.linalg.norm(image.cam_from_world().rotation.quat) - 1) > _UNIT:
            return f"the quaternion of image {image.name!r} or of its rig has no direction{_AGAIN}"
    return None


def _camera_fault(model: pycolmap.Reconstruction) -> str | None:
    used = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
    for camera_id in sorted(used):
        camera = model.camera(camera_id)
        if camera.is_spherical():
            return (
                f"camera {camera_id} is spherical ({camera.model_name}), which is not supported; cut its "
                "images into perspective ones and reconstruct those"
            )
        if fault := camera_fault(camera):
            return f"camera {camera_id} is impossible: {fault}; calibrate it or export the model again"
    return None


def _num_track_elements(model: pycolmap.Reconstruction) -> int:
    return sum(point.track.length() for point in model.points3D.values())


def num_keypoints(model: pycolmap.Reconstruction) -> dict[str, int]:
    """The number of keypoints of each image of a model that has a pose, by name."""
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.num_points2D() for image in images}


def positions(image: pycolmap.Image) -> Points2D:
    """The keypoints of an image of a model."""
    return np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)


def camera_of(image: pycolmap.Image) -> pycolmap.Camera:
    """The camera of an image of a model.

    Raises:
        ModelError: The image has no camera in the model.
    """
    if image.camera is None:
        raise ModelError(f"image {image.name!r} has no camera in the model")
    return image.camera


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


_ROUNDS = 50  # of trimming; it converges in fewer
_REACH = 2.0  # points beyond this many times the root mean square distance are background
_SPREAD = 0.25  # of the Gaussian, over the shorter side of the image
_TAIL = 0.01  # share of the weight outside either end of the box
_MOST = 0.5  # of the cameras, and length of the mean of unit vectors, in a place
_OFTEN = 3  # images that see a point of a place


def read_box(path: str | Path) -> Box:
    """Read a box from JSON (`{"corners": [[x, y, z], ...]}` or the list alone) or `box3d_corners.txt`.

    Raises:
        InputError: The file is missing, or does not hold the 8 corners of a box.
    """
    path = Path(path)
    with contents_of(path, "must hold the 8 corners of a box, each a line or list of x y z"):
        if path.suffix.lower() == ".json":
            data = read_json(path)
            corners = np.array(data["corners"] if isinstance(data, dict) else data, np.float64)
        else:
            lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
            corners = np.array(lines, np.float64)
        return Box.from_corners(corners)


def estimate_box(model: pycolmap.Reconstruction) -> Box:
    """Estimate the box of the object that the images look at, or of the place that they were taken in.

    The weight of a point grows with the number of its observations and with how close they are to the image
    centers. Points farther from the weighted mean than twice the root mean square distance are background;
    they are removed until nothing changes. The box is aligned with the principal axes of the remaining points
    and leaves out 1 % of their weight at each of its sides.

    With masks, all features and points lie on the object, and the same rule works.

    If most cameras stand in this box and look apart and not at each other's middle, it is the box of a place:
    it has the same axes and holds the points that at least three images see and the cameras, without 1 % of
    either at each of its sides.
    """
    ids = sorted(model.point3D_ids())
    points = np.array([model.point3D(i).xyz for i in ids], np.float64).reshape(-1, 3)
    weights = _centrality(model, np.array(ids, np.int64))
    inside = np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        mean = np.average(points[inside], axis=0, weights=weights[inside])
        squared = ((points - mean) ** 2).sum(axis=1)
        kept = squared <= _REACH**2 * np.average(squared[inside], weights=weights[inside])
        if np.array_equal(kept, inside):
            break
        inside = kept
    box = _box_around(points[inside], weights[inside])
    if not _is_place(model, box):
        return box
    often = np.array([model.point3D(i).track.length() for i in ids]) >= _OFTEN
    return _place_box(box, points[often] if often.sum() >= _OFTEN else points, _centers(model))


def _centers(model: pycolmap.Reconstruction) -> Points3D:
    ids = sorted(model.reg_image_ids())
    return np.array([model.image(i).projection_center() for i in ids], np.float64).reshape(-1, 3)


def _is_place(model: pycolmap.Reconstruction, box: Box) -> bool:
    """Whether most cameras stand in a box and look apart, and not at the middle of where they stand."""
    centers = _centers(model)
    looks = np.array([model.image(i).viewing_direction() for i in sorted(model.reg_image_ids())], np.float64)
    offsets = (centers - box.center) @ np.linalg.pinv(box.half_edges)
    toward = centers.mean(axis=0) - centers
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    stand_in = np.mean((np.abs(offsets) <= 1).all(axis=1))
    look_inward = np.mean(np.sum(looks * toward, axis=1))
    look_alike = np.linalg.norm(looks.mean(axis=0))
    return bool(stand_in >= _MOST and look_alike < _MOST and look_inward < _MOST)


def _place_box(box: Box, points: Points3D, centers: Float64[np.ndarray, "_ 3"]) -> Box:
    axes = box.half_edges / np.linalg.norm(box.half_edges, axis=1, keepdims=True)
    ends = [_TAIL, 1 - _TAIL]
    low_high = np.stack([np.quantile(one @ axes.T, ends, axis=0) for one in (points, centers)])
    low, high = low_high[:, 0].min(axis=0), low_high[:, 1].max(axis=0)
    return Box((low + high) / 2 @ axes, (high - low)[:, None] / 2 * axes)


def _centrality(model: pycolmap.Reconstruction, ids: Ids) -> Float64[np.ndarray, " n"]:
    """Weight per point: a Gaussian of the distance to the image center, summed over its observations."""
    weights = np.zeros(len(ids))
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        camera = model.camera(image.camera_id)
        size = np.array([camera.width, camera.height])
        squared = (((pixels - size / 2) / (_SPREAD * size.min())) ** 2).sum(axis=1)
        rows = np.searchsorted(ids, np.array([point.point3D_id for point in seen], np.int64))
        weights[rows] += np.exp(-squared / 2)
    return weights + 1e-12


def _box_around(points: Points3D, weights: Float64[np.ndarray, " n"]) -> Box:
    mean = np.average(points, axis=0, weights=weights)
    covariance = ((points - mean).T * weights) @ (points - mean)
    axes = np.linalg.eigh(covariance)[1].T
    axes *= np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None]
    coordinates = (points - mean) @ axes.T
    low, high = np.array([_weighted_range(coordinates[:, i], weights) for i in range(3)]).T
    half = np.maximum((high - low) / 2, max(1e-3 * (high - low).max(), 1e-9))
    return Box(mean + (low + high) / 2 @ axes, half[:, None] * axes)


def _weighted_range(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.searchsorted(share, (_TAIL, 1 - _TAIL))
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])
