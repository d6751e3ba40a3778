"""Cameras, local features and colors of a folder of photos.

`redescribe` computes SIFT descriptors at the keypoints of an existing model. A model stores the positions of
keypoints but not their scales and orientations. These are taken from the nearest detected SIFT feature within
two pixels. A keypoint without one gets a descriptor of zeros, which matches nothing.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

from slimsfm.arrays import GrayImage
from slimsfm.errors import ImageError, InputError, ModelError
from slimsfm.features import Extractor, Features, image_colors
from slimsfm.features.sift import Sift, root_sift
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.mapping.model import camera_of
from slimsfm.photos import camera_from_exif, read_image
from slimsfm.progress import ProgressBar

CameraSharing = Literal["auto", "shared", "per-image"]

Colors = Mapping[str, UInt8[np.ndarray, "n 3"]]
"""RGB at each keypoint, by image name."""

_REACH_PX = 2.0
_MIN_DESCRIBED = 0.2  # share of observations; with fewer, detector or images are others


def guess_cameras(images: Path, names: list[str], sharing: CameraSharing) -> dict[str, pycolmap.Camera]:
    """Guess the camera of each image from EXIF; images with equal `camera_id` share a camera.

    With "auto", images of equal size and focal length share a camera; with "shared" all do, with "per-image"
    none.

    Raises:
        InputError: An image cannot be read, or images of different sizes share a camera.
    """
    guesses = {name: camera_from_exif(images / name) for name in names}
    if sharing == "shared":
        _check_equal_sizes(guesses)
    first: dict[tuple, pycolmap.Camera] = {}
    for name, camera in guesses.items():
        camera.camera_id = len(first) + 1
        first.setdefault(_key(name, camera, sharing), camera)
    return {name: first[_key(name, camera, sharing)] for name, camera in guesses.items()}


def _key(name: str, camera: pycolmap.Camera, sharing: CameraSharing) -> tuple:
    if sharing == "shared":
        return ()
    if sharing == "per-image":
        return (name,)
    return (camera.width, camera.height, round(camera.focal_length, 2))


def _check_equal_sizes(guesses: dict[str, pycolmap.Camera]) -> None:
    sizes = {(camera.width, camera.height): name for name, camera in guesses.items()}
    if len(sizes) > 1:
        (size_a, a), (size_b, b) = list(sizes.items())[:2]
        raise InputError(
            f"{a} has {size_a[0]}x{size_a[1]} pixels, {b} {size_b[0]}x{size_b[1]}; "
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
    posed_images: list[pycolmap.Image], folder: Path, progress: ProgressBar
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
        features[image.name] = one = _redescribe_image(image, folder / image.name, extractor)
        seen = np.array(image.get_observation_point2D_idxs(), np.int64)
        observations += len(seen)
        described += int(one.descriptors[seen].any(axis=1).sum())
    if described < _MIN_DESCRIBED * observations:
        raise ModelError(
            f"{folder}: SIFT features lie at only {described} of the {observations} keypoints that see a "
            "point; give the images of this model or, if it does not use SIFT, its feature file or database"
        )
    return features, extractor


def _redescribe_image(image: pycolmap.Image, path: Path, extractor: Sift) -> Features:
    pixels = read_image(path)
    height, width = pixels.shape[:2]
    camera = camera_of(image)
    if (width, height) != (camera.width, camera.height):
        raise ImageError(
            f"{path}: {width}x{height} pixels, but its camera in the model has "
            f"{camera.width}x{camera.height}; give the images that the model was made from"
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
