"""What matching without keypoints takes and gives, and cells of an image as its keypoints [1].

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
        without CAD Models, NeurIPS 2022.
"""

from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int64, UInt8

from slimsfm.arrays import IndexPairs, Points2D
from slimsfm.features import Features, unmasked
from slimsfm.mapping.pairs import Matches, Pairs
from slimsfm.mapping.workspace import Arrays, Block, Workspace
from slimsfm.progress import ProgressBar, silent

# Without named sizes, because one call may take several images of different sizes.
Photo = UInt8[np.ndarray, "_ _ 3"]
"""RGB, upright."""

PhotoMask = UInt8[np.ndarray, "_ _"]
"""Gray, upright."""

AnyImage = Photo | PhotoMask
"""RGB or gray, upright."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMatches:
    """Matching pixels of two images, by decreasing score."""

    points2D_1: Points2D
    """Pixels of the first image."""

    points2D_2: Points2D
    """Matching pixels of the second image, row by row."""

    scores: Float32[np.ndarray, " k"]
    """Confidence of each match, from 0 to 1."""

    def __len__(self) -> int:
        return len(self.scores)

    def as_rows(self) -> Float64[np.ndarray, "k 5"]:
        """All matches as rows of an array: both pixels and the score."""
        return np.column_stack([self.points2D_1, self.points2D_2, self.scores])

    @classmethod
    def of_rows(cls, rows: Float64[np.ndarray, "k 5"]) -> "ImageMatches":
        """The matches of such rows."""
        scores = rows[:, 4].astype(np.float32)
        return cls(points2D_1=rows[:, :2], points2D_2=rows[:, 2:4], scores=scores)


@runtime_checkable
class EncodedImage(Protocol):
    """The result of encoding one image, to be matched with several others."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    @property
    def cell_px(self) -> float:
        """Side of a cell in pixels of the image; the longer one if they differ."""
        ...


Encoded = Any
"""An `EncodedImage` made by the same matcher."""


@runtime_checkable
class ImageMatcher(Protocol):
    """Matches images as a whole. Equal images give equal matches; calls are independent of each other."""

    @property
    def name(self) -> str:
        """Name of the extractor in the map's `map.json`."""
        ...

    @property
    def options(self) -> dict:
        """Keyword arguments that create an equal matcher."""
        ...

    def encode(self, image: AnyImage, *, cells_only: bool = False) -> EncodedImage:
        """Encode one image; with `cells_only`, only as far as `match_cells` needs."""
        ...

    def match(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match cells of the first image with refined pixels of the second."""
        ...

    def match_cells(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match cells of two images; a cell always has the same pixels and occurs at most once."""
        ...

    def align(self, one: Encoded, other: Encoded, points2D_1: Points2D, points2D_2: Points2D) -> Points2D:
        """Refine pixels of the second image so that they match pixels of the first.

        Args:
            one: The first image.
            other: The second image.
            points2D_1: Pixels of the first image.
            points2D_2: Approximate matches in the second image, within half a cell.
        """
        ...

    def describe(self, one: Encoded, points2D: Points2D) -> Float16[np.ndarray, "n d"]:
        """Describe pixels of one image, independently of any other image."""
        ...


_CACHED = 200  # images kept in memory, encoded for matching cells: 5 MB each at 640 x 480


@dataclass(frozen=True, kw_only=True, eq=False)
class CellKeypoints:
    """The matched cells of all images."""

    features: Mapping[str, Features]
    """Cells by image name, by decreasing sum of scores; descriptors are empty."""

    matches: Matches
    """Matches by pair of names, sorted; pairs without matches are omitted."""

    cell_px: Mapping[str, float]
    """Side of a cell in pixels, by image name."""


def match_without_keypoints(
    photos: Mapping[str, Photo],
    pairs: Pairs,
    matcher: ImageMatcher,
    workspace: Workspace,
    masks: Mapping[str, PhotoMask] | None = None,
    progress: ProgressBar = silent,
) -> CellKeypoints:
    """Match the cells of pairs of photos, and number the matched cells.

    Args:
        photos: Photos by name, read on access.
        pairs: Pairs of names.
        matcher: Matches the photos.
        workspace: Keeps matches, and has those of an interrupted build.
        masks: Masks by name, of the same sizes as the photos; cells where a mask is 0 are not matched.
        progress: Progress callback.
    """
    encode = lru_cache(_CACHED)(lambda name: matcher.encode(photos[name], cells_only=True))

    def match(a: str, b: str) -> np.ndarray:
        matches = matcher.match_cells(encode(a), encode(b))
        return _within(matches, (masks or {}).get(a), (masks or {}).get(b)).as_rows()

    def solve(blocks: Sequence[Block]) -> Generator[Arrays, None, None]:
        return ({f"{row:04}": match(*pair) for row, pair in enumerate(block)} for block in blocks)

    tiled = in_tiles(pairs, _CACHED // 2)
    solved = workspace.in_blocks(tiled, solve, progress, "match images")
    found = {
        pair: ImageMatches.of_rows(rows)
        for block, arrays in solved
        for pair, rows in zip(block, arrays.values(), strict=True)
    }
    names = sorted(photos)
    cells = _numbered(names, {pair: found[pair] for pair in sorted(found)})
    return CellKeypoints(
        features={name: cells[name].features(encode(name).image_size) for name in names},
        matches={(a, b): cells[a].pairs(cells[b], (a, b)) for a, b in sorted(found) if len(found[a, b])},
        cell_px={name: encode(name).cell_px for name in names},
    )


def in_tiles(pairs: Pairs, side: int) -> Pairs:
    """Order pairs in tiles of `side` images, so that a cache of twice as many images is seldom missed."""
    rows = {name: row // side for row, name in enumerate(sorted({name for pair in pairs for name in pair}))}
    return sorted(pairs, key=lambda pair: (rows[pair[0]], rows[pair[1]], pair))


def _within(matches: ImageMatches, mask1: PhotoMask | None, mask2: PhotoMask | None) -> ImageMatches:
    kept = unmasked(matches.points2D_1, mask1) & unmasked(matches.points2D_2, mask2)
    return ImageMatches(
        points2D_1=matches.points2D_1[kept],
        points2D_2=matches.points2D_2[kept],
        scores=matches.scores[kept],
    )


_Places = Float64[np.ndarray, "_ 2"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cells:
    """The matched cells of one image."""

    points2D: Points2D
    scores: Float32[np.ndarray, " n"]
    rows: Mapping[tuple[str, str], Int64[np.ndarray, " _"]]  # cells of each match, by pair

    def features(self, image_size: tuple[int, int]) -> Features:
        return Features(
            keypoints=self.points2D.astype(np.float32),
            descriptors=np.zeros((len(self.points2D), 0), np.float16),
            scores=self.scores,
            image_size=image_size,
        )

    def pairs(self, other: "_Cells", pair: tuple[str, str]) -> IndexPairs:
        joined = np.stack([self.rows[pair], other.rows[pair]], axis=1)
        return joined[np.argsort(joined[:, 0])]


def _numbered(names: list[str], found: Mapping[tuple[str, str], ImageMatches]) -> dict[str, _Cells]:
    places: dict[str, dict[tuple[str, str], _Places]] = defaultdict(dict)
    for (a, b), matches in found.items():
        places[a][a, b], places[b][a, b] = matches.points2D_1, matches.points2D_2
    return {name: _number(places[name], found) for name in names}


def _number(
    places: Mapping[tuple[str, str], _Places], found: Mapping[tuple[str, str], ImageMatches]
) -> _Cells:
    """Number the cells of one image by decreasing sum of scores, then by position."""
    joined = np.concatenate([np.zeros((0, 2)), *places.values()])
    scores = np.concatenate([np.zeros(0, np.float32), *(found[pair].scores for pair in places)])
    cells, which = np.unique(joined, axis=0, return_inverse=True)
    totals = np.bincount(which, weights=scores, minlength=len(cells))
    order = np.argsort(-totals, kind="stable")
    row_of = np.empty(len(cells), np.int64)
    row_of[order] = np.arange(len(cells))
    ends = np.cumsum([len(points2D) for points2D in places.values()])
    parts = np.split(row_of[which.ravel()], ends[:-1]) if len(ends) else []
    return _Cells(
        points2D=cells[order],
        scores=totals[order].astype(np.float32),
        rows=dict(zip(places, parts, strict=True)),
    )
