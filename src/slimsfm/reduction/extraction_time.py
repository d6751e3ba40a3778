"""How long this machine takes to extract the features of a photo like those of a map.

A map has no photos, so a synthetic one is measured: noise of all sizes, as photos have it, of the size of the
map's photos and with the contrast at which the map's extractor finds as many keypoints as in them.
"""

from time import perf_counter
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from jaxtyping import Float32

from slimsfm.arrays import Image
from slimsfm.errors import SlimsfmError
from slimsfm.features import Extractor
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map
from slimsfm.photos import shrink

_GRAY = 128.0
_LEAST_CONTRAST, _MOST_CONTRAST = 0.5, 40.0  # gray levels, standard deviation of the noise of each size
_STEPS = 6  # of the search for the contrast; it is found to 7 %
_CROPPED = 2  # sides of the image over those of its middle, in which keypoints are counted
_COARSEST = 4  # blobs of the coarsest noise across the shorter side
_RUNS = 3


def extraction_seconds(map: Map, longer_side: int | None = None) -> float:
    """Measure the extraction of features from an image like those of a map: the median of three runs.

    The next call for the same map and size returns the same time.

    Args:
        map: The map, with features.
        longer_side: Shrink the image to this longer side, which counts too; None: an image as large as the
            map's.

    Raises:
        MapError: The options of the extractor in the map are impossible.
        InputError: A package or weights that the extractor needs are missing.
    """
    if map not in _MEASURED:
        _MEASURED[map] = _Measured(map)
    return _MEASURED[map].seconds(longer_side)


def extraction_if_known(map: Map, longer_side: int | None = None) -> float:
    """The same; NaN if the map has no extractor of keypoints, or this is not available here."""
    try:
        return extraction_seconds(map, longer_side) if map.has_keypoints else np.nan
    except SlimsfmError:
        return np.nan


class _Measured:
    """An extractor, an image for it, and what was measured with both."""

    def __init__(self, map: Map) -> None:
        self._extractor = extractor_of(map)
        self._image = typical_image(map, self._extractor)
        self._seconds: dict[int | None, float] = {}

    def seconds(self, longer_side: int | None) -> float:
        if longer_side not in self._seconds:
            self._measure(longer_side)  # the first run also pays for what is only done once
            times = [self._measure(longer_side) for _ in range(_RUNS)]
            self._seconds[longer_side] = float(np.median(times))
        return self._seconds[longer_side]

    def _measure(self, longer_side: int | None) -> float:
        start = perf_counter()
        self._extractor.extract(self._image if longer_side is None else shrink(self._image, longer_side))
        return perf_counter() - start


_MEASURED: WeakKeyDictionary[Map, _Measured] = WeakKeyDictionary()


def typical_image(map: Map, extractor: Extractor) -> Image:
    """Noise in which the map's extractor finds about as many keypoints as in the map's images."""
    counts = {name: len(map.features[name]) for name in map.images}
    name = sorted(counts, key=lambda one: (counts[one], one))[len(counts) // 2]
    camera, factor = map.camera(name), map.shrink_factor(name)
    noise = _noise(camera.width, camera.height)
    size = round(camera.width / factor), round(camera.height / factor)
    small = cv2.resize(noise, size, interpolation=cv2.INTER_AREA)
    return _image(noise, _contrast(extractor, np.asarray(small, np.float32), counts[name]))


def _contrast(extractor: Extractor, noise: Float32[np.ndarray, "h w"], count: int) -> float:
    """The contrast at which a number of keypoints is found; there are more at a higher one."""
    height, width = (max(side // _CROPPED, 1) for side in noise.shape)
    middle = noise[height // 2 :, width // 2 :][:height, :width]
    low, high = _LEAST_CONTRAST, _MOST_CONTRAST
    for _ in range(_STEPS):
        contrast = (low * high) ** 0.5
        if len(extractor.extract(_image(middle, contrast))) * _CROPPED**2 < count:
            low = contrast
        else:
            high = contrast
    return (low * high) ** 0.5


def _noise(width: int, height: int) -> Float32[np.ndarray, "h w"]:
    """Noise of as much contrast in every octave, as photos have it; the same every time."""
    generator, total = np.random.default_rng(0), np.zeros((height, width), np.float32)
    size = 1
    while size <= min(width, height) / _COARSEST:
        grid = generator.normal(0, 1, (-(-height // size), -(-width // size))).astype(np.float32)
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        size *= 2
    return total


def _image(noise: Float32[np.ndarray, "h w"], contrast: float) -> Image:
    gray = np.clip(_GRAY + contrast * noise, 0, 255).astype(np.uint8)
    return np.repeat(gray[:, :, None], 3, axis=2)
