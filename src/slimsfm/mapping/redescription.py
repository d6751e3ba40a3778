"""Describe the keypoints of an existing model by SIFT, from its images.

A model stores the positions of keypoints but not their scales and orientations. These are taken from the
nearest detected SIFT feature within two pixels. A keypoint without one gets a descriptor of zeros, which
matches nothing.
"""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import ImageError, ModelError
from slimsfm.exif import read_orientation
from slimsfm.features import Features
from slimsfm.features.sift import Sift, root_sift
from slimsfm.files import inside
from slimsfm.mapping.agreement import counted
from slimsfm.mapping.model import camera_of, positions
from slimsfm.photos import Orientation, read_image
from slimsfm.progress import ProgressBar
from slimsfm.skipping import SkippedPhotos

_REACH_PX = 2.0
_MIN_DESCRIBED = 0.2  # share of observations; with fewer, detector or images are others
_MIN_OF_TYPICAL = 1 / 3  # an image's share over the median share
_TESTABLE = 10  # observations
_SAME = (1.0, 1.0)
_RESIZED = 1.1  # a smaller change of size comes from undistortion, which is no scaling


def redescribe(
    images: list[pycolmap.Image], folder: Path, progress: ProgressBar, orientation: Orientation = "stored"
) -> tuple[dict[str, Features], Sift, list[str]]:
    """Describe the keypoints of a model's images by SIFT.

    Photos may all be larger or smaller than the images of the model by one factor. Those that are missing or
    unreadable are skipped with a warning if they are less than half of all.

    Returns:
        The features by name of the images that were read, the extractor for queries, and notes.

    Raises:
        ImageError: Half of the images cannot be read, or one has other proportions than its camera.
        ModelError: Fewer than 20 % of the keypoints that observe a point could be described, or in some
            images far fewer than in the others. All such images are named.
    """
    extractor, features, scales = Sift(), {}, (0.0, np.inf)
    skipped = SkippedPhotos(folder)
    for image in progress(images, "describe keypoints"):
        path, camera, pixels = inside(folder, image.name), camera_of(image), None
        with skipped.skipping(image.name):
            pixels = read_image(path, orientation)
        if pixels is None:
            continue
        _check_turn(pixels, camera, path, orientation)
        scales = _common_scales(scales, pixels, camera, path)
        features[image.name] = _redescribe_image(image, _resized(pixels, camera), extractor)
    skipped.left(image.name for image in images)
    if 2 * len(features) <= len(images):
        few = f"{folder}: only {len(features)} of the {len(images)} images of the model can be used"
        raise ImageError("; ".join([few, *skipped.notes]))
    notes = [*skipped.notes, _check_shares([one for one in images if one.name in features], features, folder)]
    if scales != _SAME:
        notes.append(
            f"{folder.name}: the images are {sum(scales) / 2:.3g} times as large as those of the model; "
            "keypoints were scaled"
        )
    return features, extractor, notes


def _check_turn(pixels: Image, camera: pycolmap.Camera, path: Path, orientation: Orientation) -> None:
    """Check that a photo with an EXIF orientation lies like its image in the model."""
    if pixels.shape[:2] == (camera.width, camera.height) != (camera.height, camera.width):
        other = "upright" if orientation == "stored" else "stored"
        if read_orientation(path) != 1:
            raise ImageError(
                f"{path}: {camera.height}x{camera.width} pixels, but its camera in the model has "
                f"{camera.width}x{camera.height}; the model seems to be of its {other} pixels, so use "
                f"`orientation={other!r}`"
            )


def _common_scales(
    scales: tuple[float, float], pixels: Image, camera: pycolmap.Camera, path: Path
) -> tuple[float, float]:
    """The sizes over the model's that are possible for all photos so far and this one, within a pixel."""
    height, width = pixels.shape[:2]
    if (width, height) == (camera.width, camera.height):
        low, high = _SAME
    else:
        sides = ((width, camera.width), (height, camera.height))
        low = max((side - 1) / wanted for side, wanted in sides)
        high = min((side + 1) / wanted for side, wanted in sides)
    low, high = max(low, scales[0]), min(high, scales[1])
    is_same = (low, high) == _SAME
    if low > high or (not is_same and high > 1 / _RESIZED and low < _RESIZED):
        raise ImageError(
            f"{path}: {width}x{height} pixels, but its camera in the model has "
            f"{camera.width}x{camera.height} ({width / camera.width:.4g} times the width, "
            f"{height / camera.height:.4g} times the height); give the images that the model was made from, "
            "or all of them resized by one factor"
        )
    return low, high


def _resized(pixels: Image, camera: pycolmap.Camera) -> UInt8[np.ndarray, "h w 3"]:
    if pixels.shape[:2] == (camera.height, camera.width):
        return pixels
    how = cv2.INTER_AREA if pixels.shape[1] > camera.width else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(pixels, (camera.width, camera.height), interpolation=how), np.uint8)


def _check_shares(images: list[pycolmap.Image], features: dict[str, Features], folder: Path) -> str:
    """Check which share of the observing keypoints could be described; a note on the others."""
    shares, described, observations = {}, 0, 0
    for image in images:
        seen = np.array(image.get_observation_point2D_idxs(), np.int64)
        found = int(features[image.name].descriptors[seen].any(axis=1).sum())
        described, observations = described + found, observations + len(seen)
        if len(seen) >= _TESTABLE:
            shares[image.name] = found / len(seen)
    if described < _MIN_DESCRIBED * observations:
        raise ModelError(
            f"{folder}: SIFT features lie at only {described} of the {observations} keypoints that see a "
            "point; give the images of this model in full resolution or, if it does not use SIFT, its "
            "feature file or database"
        )
    limit = _MIN_OF_TYPICAL * float(np.median(list(shares.values()))) if shares else 0.0
    if wrong := {name: share for name, share in shares.items() if share < limit}:
        worst = max(wrong.values())
        raise ModelError(
            f"{folder}: SIFT features lie at no more than {100 * worst:.0f} % of the keypoints of "
            f"{counted(wrong)}, but typically at {100 * limit / _MIN_OF_TYPICAL:.0f} %; these photos are "
            "turned or others than the model's"
        )
    return (
        f"{folder.name}: SIFT features lie at {described} of the {observations} keypoints that see a point; "
        "the others match nothing"
    )


def _redescribe_image(image: pycolmap.Image, pixels: Image, extractor: Sift) -> Features:
    keypoints, camera = positions(image), camera_of(image)
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    return Features(
        keypoints=keypoints.astype(np.float32),
        descriptors=_describe(np.asarray(gray, np.uint8), keypoints, extractor),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(camera.width, camera.height),
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
