"""A walk through a city as a map, made without images: realistic covisibility at any size.

The camera walks along the facades of a block, for several laps, and looks at them sideways. An image sees
what is within a few steps; a later lap sees the same places again.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, UInt8

from slimsfm.arrays import IndexPairs
from slimsfm.features import Features
from slimsfm.geometry import Box
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map

_REACH = 4.0  # meters of facade that an image sees to either side
_DEPTH = 4.0  # meters from the camera to the facades, which vary by one meter
_SIZE = (640, 480)
_FOCAL = 300.0


@dataclass(frozen=True, kw_only=True)
class CityOptions:
    """Size of the city."""

    images: int = 1000
    """Length of the walk; one image per meter."""

    keypoints: int = 2000
    """Keypoints per image; about half of them see a point."""

    laps: int = 2
    """Number of times that the walk passes each place."""

    noise_px: float = 0.5
    """Standard deviation of the keypoint positions."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if self.laps < 1 or self.images < 20 * self.laps:
            raise ValueError(f"images must be at least 20 per lap, got {self.images} in {self.laps} laps")


def city_map(options: CityOptions = CityOptions()) -> Map:
    """Make the map of a walk, with features and verified matches; O(images x keypoints)."""
    walk = _Walk(options)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", _FOCAL, *_SIZE)
    model.add_camera_with_trivial_rig(camera)
    elements: list[list[tuple[int, int]]] = [[] for _ in range(len(walk.points))]
    for number in range(options.images):
        keypoints, seen = walk.keypoints(number)
        image = pycolmap.Image(name=_name(number), keypoints=keypoints, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, walk.pose(number))
        for row, point in enumerate(seen.tolist()):
            elements[point].append((number + 1, row))
    for point, seen_by in enumerate(elements):
        if len(seen_by) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(image_id, row) for image_id, row in seen_by])
            model.add_point3D_with_id(point + 1, pycolmap.Point3D(xyz=walk.points[point], track=track))
    half = np.diag(np.maximum(np.ptp(walk.points, axis=0) / 2, 1e-3))
    info = MapInfo(
        extractor="sift",
        box=Box((walk.points.max(axis=0) + walk.points.min(axis=0)) / 2, half),
        box_source="given",
        unit="metre",
        origin=f"made: a walk of {options.images} images",
    )
    return Map(model=model, features=_Features(walk), matches=_Matches(walk), info=info)


def _name(number: int) -> str:
    return f"{number:07d}.png"


class _Walk:
    """The facades as points along a circle, and what each image sees of them."""

    def __init__(self, options: CityOptions) -> None:
        self.options = options
        rng = np.random.default_rng([options.seed, 0])
        self.length = options.images / options.laps  # of a lap, in meters
        self._radius = self.length / (2 * np.pi)
        self._share = options.keypoints / 4 / _REACH  # points per meter: half of the keypoints see one
        count = int(self.length * self._share)
        self.arcs = np.sort(rng.uniform(0, self.length, count))
        depth = self._radius + _DEPTH + rng.uniform(-1, 1, count)
        angles = self.arcs / self._radius
        heights = rng.uniform(-2, 2, count)
        self.points = np.stack([depth * np.cos(angles), depth * np.sin(angles), heights], axis=1)

    def pose(self, number: int) -> pycolmap.Rigid3d:
        """Upright, at arc `number`, looking outward."""
        angle = number / self._radius
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.stack([np.cross(down, outward), down, outward])
        return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ (self._radius * outward))

    def seen(self, number: int) -> Int64[np.ndarray, " n"]:
        """Indices of the points that an image sees, ascending."""
        arc = number % self.length
        bounds = np.array([arc - _REACH, arc + _REACH])
        parts = [np.searchsorted(self.arcs, bounds + shift) for shift in (-self.length, 0.0, self.length)]
        found = np.unique(np.concatenate([np.arange(low, high) for low, high in parts]))
        inside = self._pixels(number, found)
        return found[np.all((inside > 0) & (inside < _SIZE), axis=1)].astype(np.int64)

    def keypoints(self, number: int) -> tuple[Float64[np.ndarray, "k 2"], Int64[np.ndarray, " n"]]:
        """All keypoints of an image, those that see a point first, and the indices of these points."""
        rng, seen = np.random.default_rng([self.options.seed, 1, number]), self.seen(number)
        pixels = self._pixels(number, seen) + rng.normal(0, self.options.noise_px, (len(seen), 2))
        stray = rng.uniform(0, _SIZE, (max(self.options.keypoints - len(seen), 0), 2))
        return np.concatenate([pixels, stray]), seen

    def _pixels(self, number: int, points: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
        in_cam = self.pose(number) * self.points[points]
        return _FOCAL * in_cam[:, :2] / in_cam[:, 2:] + np.array(_SIZE) / 2


class _Features(Mapping[str, Features]):
    """Features computed on access: a point's descriptor comes from its own seed, plus noise."""

    def __init__(self, walk: _Walk) -> None:
        self._walk = walk
        rng = np.random.default_rng([walk.options.seed, 2])
        self._descriptors = rng.integers(0, 120, (len(walk.points), 128), np.uint8)

    def __getitem__(self, name: str) -> Features:
        number = int(name.split(".")[0])
        keypoints, seen = self._walk.keypoints(number)
        rng = np.random.default_rng([self._walk.options.seed, 3, number])
        stray = rng.integers(0, 120, (len(keypoints) - len(seen), 128), np.uint8)
        own: UInt8[np.ndarray, "n 128"] = self._descriptors[seen] + rng.integers(
            0, 20, (len(seen), 128), np.uint8
        )
        return Features(
            keypoints=keypoints.astype(np.float32),
            descriptors=np.concatenate([own, stray]),
            scores=np.ones(len(keypoints), np.float32),
            image_size=_SIZE,
        )

    def __iter__(self) -> Iterator[str]:
        return map(_name, range(self._walk.options.images))

    def __len__(self) -> int:
        return self._walk.options.images


class _Matches(Mapping[tuple[str, str], IndexPairs]):
    """Matches of images at most half a reach apart, on any lap: the points that both see."""

    def __init__(self, walk: _Walk) -> None:
        self._walk = walk

    def __getitem__(self, pair: tuple[str, str]) -> IndexPairs:
        a, b = (self._walk.seen(int(name.split(".")[0])) for name in pair)
        _, rows_a, rows_b = np.intersect1d(a, b, return_indices=True)
        return np.stack([rows_a, rows_b], axis=1).astype(np.int64)

    def __contains__(self, pair: object) -> bool:
        return pair in set(self)

    def __iter__(self) -> Iterator[tuple[str, str]]:
        options, length = self._walk.options, self._walk.length
        nearby = np.arange(-int(_REACH / 2), int(_REACH / 2) + 1)
        for a in range(options.images):
            laps = np.round(length * np.arange(options.laps)).astype(np.int64)
            others = np.unique((a % int(length) + laps[:, None] + nearby[None]).ravel() % options.images)
            for b in others[others > a].tolist():
                yield _name(a), _name(b)

    def __len__(self) -> int:
        return sum(1 for _ in self)
