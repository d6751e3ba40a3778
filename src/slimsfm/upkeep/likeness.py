"""Images that add nothing: duplicates, and those that are less sharp than others that show the same."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from slimsfm.arrays import Image
from slimsfm.features import Features
from slimsfm.files import inside
from slimsfm.geometry import corner_error
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import Matches
from slimsfm.photos import read_image, shrink
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.findings import Blurred, Duplicate

Neighbors = Mapping[str, Sequence[str]]
"""By image the others that it has verified matches with, those with the most matches first."""

_SAME_PIXELS = 0.002  # median distance of the matches of duplicates, over the longer side
_SAME_KEYPOINTS = 0.5  # share of the keypoints of duplicates that match
_NEIGHBORS, _FEWEST = 10, 3  # that an image is compared with
_SMALL = 0.25  # share of the neighbors' keypoints that count as small
_BLURRED_PIXELS, _BLURRED_FEATURES = 0.25, 0.4  # of the neighbors' sharpness
_SIDE = 640  # pixels of the longer side at which photos are judged


def find_duplicates(map: Map, matches: Matches) -> tuple[Duplicate, ...]:
    """Find pairs of images most of whose keypoints match at the same pixels."""
    found = []
    for a, b in sorted(pair for pair in matches if map.images.keys() >= set(pair)):
        rows = matches[a, b]
        matched = len(rows) / max(min(map.images[name].num_points2D() for name in (a, b)), 1)
        if matched < _SAME_KEYPOINTS:
            continue
        one, other = (map.features[name].keypoints for name in (a, b))
        moved = np.linalg.norm(one[rows[:, 0]] - other[rows[:, 1]], axis=1)
        if float(np.median(moved)) <= _SAME_PIXELS * max(map.camera(a).width, map.camera(a).height):
            poses = [map.images[name].cam_from_world() for name in (a, b)]
            found.append(
                Duplicate(
                    name=a,
                    copy=b,
                    matched=matched,
                    moved_px=float(np.median(moved)),
                    distance=corner_error(poses[0], poses[1], map.box),
                )
            )
    return tuple(found)


def find_blurred(
    map: Map, neighbors: Neighbors, images: Path | None = None, progress: ProgressBar = silent
) -> tuple[Blurred, ...]:
    """Find images that are less sharp than those they have the most matches with.

    Args:
        map: The map.
        neighbors: With whom each image is compared: the first ten. With fewer than three, it is not.
        images: Folder of the photos. Without it, keypoints tell: blur leaves no small ones. Features without
            a scale tell nothing.
        progress: Progress callback.

    Raises:
        ImageError: A photo cannot be read.
    """
    if images is None:
        return tuple(_without_small_keypoints(map, neighbors))
    detail = {
        name: _detail(read_image(inside(images, name), map.info.orientation))
        for name in progress(list(map.images), "look at photos")
    }
    found = []
    for name, own in detail.items():
        near = [detail[one] for one in neighbors[name][:_NEIGHBORS]]
        sharpness = own / max(float(np.median(near or [0.0])), 1e-12)
        if len(near) >= _FEWEST and sharpness < _BLURRED_PIXELS:
            found.append(Blurred(name=name, sharpness=sharpness, measured_by="pixels"))
    return tuple(found)


def _detail(image: Image) -> float:
    """Contrast of fine detail over the contrast of the whole image."""
    gray = cv2.cvtColor(shrink(image, _SIDE), cv2.COLOR_RGB2GRAY).astype(np.float64)
    return float(cv2.Laplacian(gray, cv2.CV_64F).var() / max(gray.var(), 1.0))


def _without_small_keypoints(map: Map, neighbors: Neighbors) -> Iterator[Blurred]:
    sizes = {name: _sizes(map.features[name]) for name in map.images}
    for name, own in sizes.items():
        near = [sizes[one] for one in neighbors[name][:_NEIGHBORS] if len(sizes[one])]
        if len(near) < _FEWEST or not len(own):
            continue
        small = float(np.median([np.quantile(one, _SMALL) for one in near]))
        sharpness = float(np.mean(own <= small)) / _SMALL
        if sharpness < _BLURRED_FEATURES:
            yield Blurred(name=name, sharpness=sharpness, measured_by="features")


def _sizes(features: Features) -> Float64[np.ndarray, " n"]:
    """Scales of the keypoints; none if the extractor estimates none."""
    return np.zeros(0) if features.frames is None else features.frames[:, 0].astype(np.float64)
