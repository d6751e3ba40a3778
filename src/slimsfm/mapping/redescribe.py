"""SIFT descriptors at keypoints that a model has, from the images.

A model tells where a keypoint is but not its size and direction. They are those of the SIFT feature detected
nearest to it, if there is one within two pixels. A keypoint without gets a descriptor of zeros, which matches
nothing.
"""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8
from scipy.spatial import KDTree

from slimsfm.arrays import GrayImage
from slimsfm.errors import ImageError, ModelError
from slimsfm.features import Features
from slimsfm.features.sift import Sift, root_sift
from slimsfm.mapping.model import camera_of
from slimsfm.photos import read_image
from slimsfm.progress import ProgressBar

_REACH_PX = 2.0
_MIN_DESCRIBED = 0.2  # share of observations; fewer and the keypoints are of another kind or other images


def redescribe(
    posed_images: list[pycolmap.Image], folder: Path, progress: ProgressBar
) -> tuple[dict[str, Features], Sift]:
    """Describe the keypoints of images; returns the features by name and the extractor for queries.

    Raises:
        ImageError: An image is missing, unreadable or of another size than its camera.
        ModelError: Hardly a keypoint that sees a point could be described.
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
            "point; are these the model's images? Else give its own: `features=FILE` or `database=FILE`"
        )
    return features, extractor


def _redescribe_image(image: pycolmap.Image, path: Path, extractor: Sift) -> Features:
    pixels = read_image(path)
    height, width = pixels.shape[:2]
    camera = camera_of(image)
    if (width, height) != (camera.width, camera.height):
        raise ImageError(
            f"{path}: {width}x{height} pixels, but its camera in the model has "
            f"{camera.width}x{camera.height}; give the images that the model was made of"
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
    distances, rows_nearest = KDTree(pixels).query(keypoints)
    nearest = np.asarray(rows_nearest)
    rows = np.flatnonzero(distances < _REACH_PX)
    wanted = []
    for row in rows:
        one = detected[nearest[row]]
        x, y = (keypoints[row] - 0.5).tolist()
        # OpenCV may drop or reorder keypoints: the row travels along as the class.
        wanted.append(cv2.KeyPoint(x, y, one.size, one.angle, one.response, one.octave, int(row)))
    computed, found = detector.compute(gray, wanted)
    if found is not None:
        descriptors[[one.class_id for one in computed]] = root_sift(found)
    return descriptors
