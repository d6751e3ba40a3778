"""Features of a query in rounds, from a small version of the image to the whole one.

Most queries are localized by an eighth of their pixels, and extraction takes time in proportion to them. So
features are extracted from a shrunken image first. If the pose is not sure, a larger image follows, of the
part where the map's points should be if there is a pose, and finally the whole image. All rounds before the
last have at most a third of its pixels.
"""

from collections.abc import Callable, Generator
from time import perf_counter
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from slimsfm.arrays import GrayImage, Image
from slimsfm.features import Features
from slimsfm.localization.extraction import (
    SMALLEST_SCALE_PX,
    Extracted,
    SizedExtractor,
    Window,
    second_size,
)

ExtractionChoice = Literal["rounds", "whole"]


class Level(NamedTuple):
    """Features of one round of extraction."""

    extracted: Extracted
    """The features."""

    is_last: bool
    """Whether no more features follow."""


class Seen(NamedTuple):
    """What a search has found with the features of a level."""

    window: Window | None = None
    """Where the points of the map should be, if there is a pose that is believed."""

    is_sure: bool = False
    """Whether the pose is sure, and only not exact enough."""

    def share(self, width: int, height: int) -> float:
        """Share of an image that the window covers."""
        return 1.0 if self.window is None else self.window.area / (width * height)


Levels = Generator[Level, Seen, None]
"""Yields features, finer ones or more of them in each round; is sent what was found with the last ones. Ends
early where further features would bring nothing."""


def given_features(features: Features, factor: float) -> Levels:
    """The one level of features that have been extracted; `factor` is their `Extracted.shrink_factor`."""
    yield Level(Extracted(features, factor), is_last=True)


@runtime_checkable
class FeatureSource(Protocol):
    """Where features of one image come from."""

    @property
    def image(self) -> Image | None:
        """The image, RGB; None if it is not known."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        ...

    @property
    def seconds(self) -> float:
        """Time of all extractions so far."""
        ...

    def at(self, extractor: SizedExtractor, size: int) -> Extracted:
        """Features of the image, shrunk to this longer side."""
        ...

    def part(self, extractor: SizedExtractor, size: int, window: Window) -> Extracted:
        """Features of a part of the image, shrunk as the whole one to this longer side."""
        ...


def levels_of(source: FeatureSource, extractor: SizedExtractor, choice: ExtractionChoice) -> Levels:
    """Extract the features of an image for one map, as much of them as the search asks for."""
    whole = extractor.whole_size(*source.size)
    first = whole if choice == "whole" else extractor.first_size(*source.size)
    if first < whole:
        seen = yield Level(source.at(extractor, first), is_last=False)
        size = second_size(whole, first, seen.share(*source.size))
        if size:
            seen = yield Level(_inside(source, extractor, size, seen.window), is_last=False)
        if seen.is_sure and seen.window:  # further features could only make the pose more exact
            if size != whole:
                yield Level(source.part(extractor, whole, seen.window), is_last=True)
            return
    yield Level(source.at(extractor, whole), is_last=True)


def _inside(source: FeatureSource, extractor: SizedExtractor, size: int, window: Window | None) -> Extracted:
    return source.at(extractor, size) if window is None else source.part(extractor, size, window)


class ImageRounds:
    """Extracts features of one image; those of a size of the whole image once for all maps.

    Attributes:
        image: The image.
        seconds: Wall time of all extractions so far.
    """

    def __init__(self, image: Image, mask: GrayImage | None = None) -> None:
        self.image, self._mask = image, mask
        self._extracted: dict[tuple[str, int], Extracted] = {}
        self.seconds = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.image.shape[1], self.image.shape[0]

    def at(self, extractor: SizedExtractor, size: int) -> Extracted:
        """Features of the shrunken image; extracts them unless an equal extractor has done it."""
        key = extractor.key, size
        if key not in self._extracted:
            self._extracted[key] = self._timed(lambda: extractor.extract(self.image, self._mask, size))
        return self._extracted[key]

    def part(self, extractor: SizedExtractor, size: int, window: Window) -> Extracted:
        """Features of a part of the shrunken image."""
        return self._timed(lambda: extractor.extract(self.image, self._mask, size, window))

    def _timed(self, extract: Callable[[], Extracted]) -> Extracted:
        start = perf_counter()
        found = extract()
        self.seconds += perf_counter() - start
        return found


class StoredRounds:
    """Features of an image of a map, as they would be extracted in rounds: those that are large enough.

    Attributes:
        image: None: a map has no images.
        seconds: Predicted time of all extractions so far.
    """

    image = None

    def __init__(self, features: Features, extract_seconds: Callable[[int], float]) -> None:
        """Take the features of the whole image.

        Args:
            features: The features.
            extract_seconds: Predicts the time of an extraction from the image, shrunk to a longer side.
        """
        self._features, self._extract_seconds = features, extract_seconds
        self.seconds = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self._features.image_size

    def at(self, extractor: SizedExtractor, size: int) -> Extracted:  # noqa: ARG002
        """Features that the shrunken image has too."""
        self.seconds += self._extract_seconds(size)
        factor = max(self.size) / size
        if factor <= 1:
            return Extracted(self._features, 1.0)
        found = np.flatnonzero(self._scales >= SMALLEST_SCALE_PX * factor)
        return Extracted(self._features[found], factor)

    def part(self, extractor: SizedExtractor, size: int, window: Window) -> Extracted:
        """Those of them that lie in the part; their extraction takes time in proportion to its pixels."""
        before = self.seconds
        found = self.at(extractor, size)
        self.seconds = before + (self.seconds - before) * window.area / (self.size[0] * self.size[1])
        x, y = found.features.keypoints.T
        inside = (x >= window.left) & (x < window.right) & (y >= window.top) & (y < window.bottom)
        return Extracted(found.features[np.flatnonzero(inside)], found.shrink_factor)

    @property
    def _scales(self) -> np.ndarray:
        frames = self._features.frames
        return np.full(len(self._features), np.inf) if frames is None else frames[:, 0]
