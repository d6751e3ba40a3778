"""Cameras, local features and colors of a folder of photos.

`redescribe` computes SIFT descriptors at the keypoints of an existing model. A model stores the positions of
keypoints but not their scales and orientations. These are taken from the nearest detected SIFT feature within
two pixels. A keypoint without one gets a descriptor of zeros, which matches nothing.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

from slimsfm.arrays import GrayImage
from slimsfm.errors import ImageError, InputError, ModelError
from slimsfm.exif import Exif, read_orientation
from slimsfm.features import Extractor, Features, image_colors
from slimsfm.features.sift import Sift, root_sift
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.mapping.model import camera_of
from slimsfm.photos import Orientation, read_image
from slimsfm.progress import ProgressBar

CameraSharing = Literal["auto", "shared", "per-image"]

Colors = Mapping[str, UInt8[np.ndarray, "n 3"]]
"""RGB at each keypoint, by image name."""

_REACH_PX = 2.0
_MIN_DESCRIBED = 0.2  # share of observations; with fewer, detector or images are others


@dataclass(frozen=True, kw_only=True, eq=False)
class GuessedCameras:
    """Cameras of images, guessed from EXIF."""

    by_name: Mapping[str, pycolmap.Camera]
    """The camera of each image in its own pixels; images with equal `camera_id` share a camera."""

    turned: Mapping[str, pycolmap.Camera] = field(default_factory=dict)
    """Images taken with the camera of others, held turned by 90°: the camera of the others."""


def guess_cameras(
    exifs: Mapping[str, Exif], sharing: CameraSharing, orientation: Orientation = "upright"
) -> GuessedCameras:
    """Guess the camera of each image from its EXIF data, by name.

    With "auto", images of equal size, focal length and device share a camera; with "shared" all do, with
    "per-image" none. Pictures of swapped width and height are of one camera, held upright and sideways.

    Raises:
        InputError: Images of different sizes share a camera.
    """
    guesses = {name: exif.camera(orientation) for name, exif in exifs.items()}
    if sharing == "shared":
        _check_equal_sizes(guesses)
    groups: dict[tuple, list[str]] = {}
    for name, camera in guesses.items():
        groups.setdefault(_key(name, exifs[name], camera, sharing), []).append(name)
    by_name, turned = {}, {}
    for names in groups.values():
        first: dict[int, pycolmap.Camera] = {}  # by width
        for name in names:
            guesses[name].camera_id = 1 + len({camera.camera_id for camera in by_name.values()})
            by_name[name] = first.setdefault(guesses[name].width, guesses[name])
        widths = Counter(by_name[name].width for name in names)
        usual = max(widths, key=lambda width: (widths[width], width))
        turned |= {name: first[usual] for name in names if by_name[name].width != usual}
    return GuessedCameras(by_name={name: by_name[name] for name in exifs}, turned=turned)


def _key(name: str, exif: Exif, camera: pycolmap.Camera, sharing: CameraSharing) -> tuple:
    if sharing == "shared":
        return ()
    if sharing == "per-image":
        return (name,)
    return (*sorted(exif.stored_size), round(camera.focal_length, 2), exif.device)


def _check_equal_sizes(guesses: Mapping[str, pycolmap.Camera]) -> None:
    sizes = {tuple(sorted((camera.width, camera.height))): name for name, camera in guesses.items()}
    if len(sizes) > 1:
        a, b = (guesses[name] for name in list(sizes.values())[:2])
        name_a, name_b = list(sizes.values())[:2]
        raise InputError(
            f"{name_a} has {a.width}x{a.height} pixels, {name_b} {b.width}x{b.height}; "
            "images that share a camera must have the same size, so use `camera='auto'`"
        )


def extract_features(
    photos: MaskedPhotos, names: list[str], extractor: Extractor, output: Path, progress: ProgressBar
) -> tuple[FeatureFile, Colors]:
    """Extract the features of images to a file.

    Raises:
        InputError: An image cannot be read, its mask is unreadable or of another size, or masks leave fewer
            than two images with pixels.
    """
    colors = {}
    with FeatureWriter(output) as writer:
        for name in progress(names, "extract features"):
            photo = photos.read(name)
            features = extractor.extract(photo.image, photo.mask)
            colors[name] = image_colors(photo.image, features.keypoints)
            writer.write(name, features)
    photos.check()
    return FeatureFile(output), colors


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Set the color of each point to the mean color of its observations."""
    names = {image_id: image.name for image_id, image in model.images.items()}
    for point in model.points3D.values():
        seen = [colors[names[element.image_id]][element.point2D_idx] for element in point.track.elements]
        point.color = np.mean(seen, axis=0).round().astype(np.uint8)


def redescribe(
    posed_images: list[pycolmap.Image], folder: Path, progress: ProgressBar, orientation: Orientation
) -> tuple[dict[str, Features], Sift]:
    """Describe the keypoints of a model's images by SIFT.

    Returns:
        The features by image name, and the extractor for queries.

    Raises:
        ImageError: An image is missing, unreadable or of another size than its camera.
        ModelError: Fewer than 20 % of the keypoints that observe a point could be described.
    """
    extractor = Sift()
    features = {}
    observations = described = 0
    for image in progress(posed_images, "describe keypoints"):
        features[image.name] = one = _redescribe_image(image, folder / image.name, extractor, orientation)
        seen = np.array(image.get_observation_point2D_idxs(), np.int64)
        observations += len(seen)
        described += int(one.descriptors[seen].any(axis=1).sum())
    if described < _MIN_DESCRIBED * observations:
        raise ModelError(
            f"{folder}: SIFT features lie at only {described} of the {observations} keypoints that see a "
            "point; give the images of this model or, if it does not use SIFT, its feature file or database"
        )
    return features, extractor


def _redescribe_image(
    image: pycolmap.Image, path: Path, extractor: Sift, orientation: Orientation
) -> Features:
    pixels = read_image(path, orientation)
    height, width = pixels.shape[:2]
    camera = camera_of(image)
    if (width, height) != (camera.width, camera.height):
        turned = read_orientation(path) != 1 and (height, width) == (camera.width, camera.height)
        other = "upright" if orientation == "stored" else "stored"
        advice = (
            f"the model seems to be of its {other} pixels, so use `orientation={other!r}`"
            if turned
            else "give the images that the model was made from"
        )
        raise ImageError(
            f"{path}: {width}x{height} pixels, but its camera in the model has "
            f"{camera.width}x{camera.height}; {advice}"
        )
    keypoints = np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    return Features(
        keypoints=keypoints.astype(np.float32),
        descriptors=_describe(np.asarray(gray, np.uint8), keypoints, extractor),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(width, height),
    )


def _describe(
    gray: GrayImage, keypoints: Float64[np.ndarray, "n 2"], extractor: Sift
) -> UInt8[np.ndarray, "n 128"]:
    detector = cv2.SIFT.create(
        0, contrastThreshold=extractor.contrast_threshold / 2, enable_precise_upscale=True
    )
    descriptors = np.zeros((len(keypoints), 128), np.uint8)
    detected = detector.detect(gray, None)
    if not detected or not len(keypoints):
        return descriptors
    pixels = np.array([one.pt for one in detected]) + 0.5
    from scipy.spatial import KDTree  # slow to import, and only needed here

    distances, rows_nearest = KDTree(pixels).query(keypoints)
    nearest = np.asarray(rows_nearest)
    rows = np.flatnonzero(distances < _REACH_PX)
    wanted = []
    for row in rows:
        one = detected[nearest[row]]
        x, y = (keypoints[row] - 0.5).tolist()
        # OpenCV may drop or reorder keypoints; class_id keeps the row.
        wanted.append(cv2.KeyPoint(x, y, one.size, one.angle, one.response, one.octave, int(row)))
    computed, found = detector.compute(gray, wanted)
    if found is not None:
        descriptors[[one.class_id for one in computed]] = root_sift(found)
    return descriptors
