"""Points that images which should see them never match: of things that have gone, or triangulated by chance.

An image should see a point that projects into it if another image sees the point from nearly the same
direction and distance: then nothing hides it. It matches the point if one of its keypoints near the
projection resembles the point.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from slimsfm.arrays import Ids
from slimsfm.features import unit_rows
from slimsfm.geometry import project
from slimsfm.localization.appearances import descriptor_sums
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent

_MAX_ANGLE_DEG, _MAX_RATIO = 15.0, 1.3  # between directions and distances from which a point looks alike
_NEAR_PX = 8.0  # of the projection, in pixels in which features were found
_BORDER = 0.03  # of the sides of the image, where little decides whether a point is in it
_NEIGHBORS = 20  # images that are compared with an image: those with the nearest cameras
_FEWEST_MISSES, _SHARE = 3, 0.75  # of a point that is forgotten


@dataclass(frozen=True, kw_only=True, eq=False)
class PointCounts:
    """How often each point was seen, by row of the map's points."""

    seen: Ids
    """Number of images that observe it, or have a keypoint like it at its place."""

    missed: Ids
    """Number of images that should see it and have none."""

    def forgettable(self) -> Ids:
        """Rows of the points that at least three images miss, three of four of those that should see them."""
        share = self.missed / np.maximum(self.seen + self.missed, 1)
        return np.flatnonzero((self.missed >= _FEWEST_MISSES) & (share >= _SHARE))


def count_misses(map: Map, progress: ProgressBar = silent) -> PointCounts:
    """Count, for each point, the images that match it and those that should but do not.

    O(images times observations of 20 neighbors).
    """
    names = list(map.images)
    centers = np.array([map.images[name].projection_center() for name in names])
    tree, most = KDTree(centers), min(_NEIGHBORS + 1, len(names))
    points = unit_rows(descriptor_sums(map))
    seen = np.zeros(len(map.point3D_ids), np.int64)
    missed = np.zeros_like(seen)
    for row in progress(list(range(len(names))), "look for points that are missed"):
        observed = map.observations[names[row]].points
        seen[observed] += 1
        nearest = np.atleast_1d(tree.query(centers[row], most)[1])
        neighbors = [names[other] for other in nearest.tolist() if other != row]
        expected = np.setdiff1d(_expected(map, names[row], neighbors), observed)
        found = _matched(map, names[row], expected, points[expected])
        seen[expected[found]] += 1
        missed[expected[~found]] += 1
    return PointCounts(seen=seen, missed=missed)


def _expected(map: Map, name: str, neighbors: list[str]) -> Ids:
    """Points in an image that neighbors see from nearly the same direction and distance."""
    found = [points_in_view(map, name, other) for other in neighbors]
    return np.unique(np.concatenate([*found, np.zeros(0, np.int64)]))


def points_in_view(map: Map, name: str, other: str) -> Ids:
    """Rows of the points of another image that an image should see: in view, and looked at alike by both.

    Both look from directions that differ by at most 15 degrees, and from distances of a ratio up to 1.3, so
    that nothing hides them from only one of them.
    """
    image, camera = map.images[name], map.camera(name)
    here, there = image.projection_center(), map.images[other].projection_center()
    rows = np.unique(map.observations[other].points)
    places = map.points3D_in_world[rows]
    rows = rows[_looks_alike(here - places, there - places)]
    pixels = project(map.points3D_in_world[rows], image.cam_from_world(), camera)
    size = np.array([camera.width, camera.height])
    return rows[np.all((pixels >= _BORDER * size) & (pixels <= (1 - _BORDER) * size), axis=1)]


def _looks_alike(a: Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    lengths = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    cosines = np.einsum("nd,nd->n", a, b) / np.maximum(lengths[0] * lengths[1], 1e-12)
    ratios = np.maximum(*lengths) / np.maximum(np.minimum(*lengths), 1e-12)
    return (cosines >= np.cos(np.radians(_MAX_ANGLE_DEG))) & (ratios <= _MAX_RATIO)


def _matched(map: Map, name: str, rows: Ids, descriptors: np.ndarray) -> np.ndarray:
    """Which points have a keypoint like them near their projections."""
    features = map.features[name]
    if not len(rows) or not len(features):
        return np.zeros(len(rows), bool)
    pixels = project(map.points3D_in_world[rows], map.images[name].cam_from_world(), map.camera(name))
    near = KDTree(features.keypoints).query_ball_point(pixels, _NEAR_PX * map.shrink_factor(name))
    least = np.cos(map.descriptor_metric.max_distance)
    found = np.zeros(len(rows), bool)
    for place, candidates in enumerate(near):
        if len(candidates):
            alike = unit_rows(features.descriptors[sorted(candidates)]) @ descriptors[place]
            found[place] = alike.max() >= least
    return found
