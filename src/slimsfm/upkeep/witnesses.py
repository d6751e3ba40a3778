"""Where the other images of a map say that an image stands, without what the image itself contributed.

An image and a reference are joined by verified matches, which no pose has a part in. Where the matched
keypoint of the reference observes a point, the match is a 2D-3D match of the image. The position of the point
must not depend on the image either: it is triangulated again from the other observations.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, IndexPairs, Mask, Points2D, Points3D
from slimsfm.geometry import corner_error, reprojection_errors, resized_camera
from slimsfm.mapping.map import Map
from slimsfm.mapping.model import positions
from slimsfm.mapping.pairs import Matches
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

MIN_INLIERS = 15
"""Matches that must agree with a pose that one set of references gives; as of a verified pair in COLMAP."""

_MAX_ERROR_PX = 4.0  # of an observation that counts; COLMAP drops others
_MIN_ANGLE = np.radians(1.0)  # between the rays of a point
_MOST_MATCHES = 800  # per pose: more of them hardly change it
_MOST_REFERENCES = 24  # of an image
_NEED = 2  # observations of a point
_SCATTER = 4.0  # times the median error of the inliers: by how much a match may be off another pose
_LEAST_PX = 1.5  # of that


@dataclass(frozen=True, kw_only=True, eq=False)
class Testimony:
    """Where one set of references says that an image stands."""

    references: tuple[str, ...]
    """Names of the references, those with the most matches first."""

    cam_from_world: pycolmap.Rigid3d
    """The pose of the image."""

    inliers: int
    """Number of matches that agree with it."""

    agreeing: int
    """Number of these matches that also agree with the pose that the map has, as closely as they scatter."""

    distance: float
    """Relative corner error between both poses."""

    predicted_error: float
    """Predicted relative corner error of the pose, if its inliers are right."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """An image in pixels in which its features were found."""

    name: str
    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    pixels: Points2D
    points: Ids
    """Row of the point that each keypoint observes, or -1."""

    normals: Float64[np.ndarray, "m 6"]
    """Upper triangle of the normal matrix that each of its observations adds to its point."""

    sides: Float64[np.ndarray, "m 3"]
    """Right side that each of its observations adds."""

    seen: Int64[np.ndarray, " m"]
    """Row of the point of each observation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Matched:
    """2D-3D matches of an image with the points of some references."""

    keypoints: Ids
    """Keypoints of the image."""

    points3D: Points3D
    """The points, triangulated without the image."""


class Witnesses:
    """Localizes the images of a map from each other, without what they or suspects contributed to the map.

    Args:
        map: A full map.
        matches: Verified matches by pair of names.

    Notes:
        Triangulation is the least squares of distances to rays, each weighted by focal length over depth,
        that is of angular errors. Its normal equations are sums over the observations, so that leaving an
        image out is a subtraction.
    """

    def __init__(self, map: Map, matches: Matches) -> None:
        self._box = map.box
        self.names = tuple(map.images)
        self._views = [_view(map, name) for name in self.names]
        self._pairs = _pairs_by_image(self.names, matches)
        self._suspects: frozenset[int] = frozenset()
        count = len(map.point3D_ids)
        self._normals, self._sides = np.zeros((count, 6)), np.zeros((count, 3))
        self._counts = np.zeros(count, np.int64)
        for view in self._views:
            self._add(view, 1)
        self._places = _solved(self._normals, self._sides, self._counts)

    def neighbors(self, index: int) -> list[int]:
        """The images that have verified matches with an image, those with the most first."""
        return [other for other, _ in self._pairs[index]]

    def references(self, index: int) -> list[int]:
        """The first 24 of its neighbors that are no suspects."""
        return [other for other in self.neighbors(index) if other not in self._suspects][:_MOST_REFERENCES]

    def suspect(self, indices: Iterable[int]) -> None:
        """Take out what some images contributed, instead of those that were taken out before."""
        wanted = frozenset(indices)
        changed = [(i, -1) for i in wanted - self._suspects] + [(i, 1) for i in self._suspects - wanted]
        for index, sign in sorted(changed):
            self._add(self._views[index], sign)
        self._suspects = wanted
        if changed:
            rows = np.unique(np.concatenate([self._views[i].seen for i, _ in changed]))
            self._places[rows] = _solved(self._normals[rows], self._sides[rows], self._counts[rows])

    def testimony(self, index: int, references: Sequence[int]) -> Testimony | None:
        """The pose of an image by some references; None if they do not give one."""
        view, matched = self._views[index], self.matched(index, references)
        step = max(1, -(-len(matched.keypoints) // _MOST_MATCHES))
        pixels, points3D = view.pixels[matched.keypoints[::step]], matched.points3D[::step]
        pose = estimate_pose(pixels, points3D, view.camera)
        if pose is None or pose.num_inliers < MIN_INLIERS:
            return None
        found_px, stored_px = (
            reprojection_errors(pixels, points3D, one, view.camera)
            for one in (pose.cam_from_world, view.cam_from_world)
        )
        scatter_px = float(np.median(found_px[pose.inliers]))
        limit_px = np.clip(_SCATTER * scatter_px, _LEAST_PX, RansacOptions().max_error_px)
        rows = matched.keypoints[::step]
        return Testimony(
            references=tuple(self.names[i] for i in references),
            cam_from_world=pose.cam_from_world,
            inliers=_num_keypoints(rows, pose),
            agreeing=len(np.unique(rows[pose.inliers & (stored_px <= limit_px)])),
            distance=corner_error(pose.cam_from_world, view.cam_from_world, self._box),
            predicted_error=pose.predicted_corner_error(self._box),
        )

    def matched(self, index: int, references: Sequence[int]) -> Matched:
        """The 2D-3D matches of an image with what some references observe."""
        wanted, view = set(references), self._views[index]
        keypoints, points = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for other, rows in self._pairs[index]:
            if other in wanted:
                found = self._views[other].points[rows[:, 1]]
                keypoints.append(rows[found >= 0, 0])
                points.append(found[found >= 0])
        count = max(len(self._places), 1)
        pairs = np.unique(np.concatenate(keypoints) * count + np.concatenate(points))
        pair_keypoints, pair_points = np.divmod(pairs, count)
        places = self._places[pair_points]
        own = np.isin(pair_points, view.seen) & (index not in self._suspects)
        places[own] = self._without(view, pair_points[own])
        known = np.isfinite(places).all(axis=1)
        return Matched(keypoints=pair_keypoints[known], points3D=places[known])

    def _add(self, view: _View, sign: int) -> None:
        np.add.at(self._normals, view.seen, sign * view.normals)
        np.add.at(self._sides, view.seen, sign * view.sides)
        np.add.at(self._counts, view.seen, sign)

    def _without(self, view: _View, points: Ids) -> Points3D:
        """Positions of points without the observations of an image, which sees all of them."""
        rows, places = np.unique(points, return_inverse=True)
        normals, sides, counts = self._normals[rows], self._sides[rows], self._counts[rows]
        own = np.isin(view.seen, rows)
        targets = np.searchsorted(rows, view.seen[own])
        np.subtract.at(normals, targets, view.normals[own])
        np.subtract.at(sides, targets, view.sides[own])
        np.subtract.at(counts, targets, 1)
        return _solved(normals, sides, counts)[places]


def _num_keypoints(rows: Ids, pose: PoseEstimate) -> int:
    return len(np.unique(rows[pose.inliers]))


def _view(map: Map, name: str) -> _View:
    image, seen, factor = map.images[name], map.observations[name], map.shrink_factor(name)
    camera, pixels = map.camera(name), positions(image)
    if factor > 1:
        camera, pixels = resized_camera(camera, 1 / factor), pixels / factor
    pose, points3D = image.cam_from_world(), map.points3D_in_world[seen.points]
    errors = reprojection_errors(pixels[seen.rows], points3D, pose, camera)
    good = errors <= _MAX_ERROR_PX
    rows, points = seen.rows[good], seen.points[good]
    of_keypoints = np.full(len(pixels), -1, np.int64)
    of_keypoints[rows] = points
    normals, sides = _equations(pixels[rows], points3D[good], pose, camera)
    return _View(
        name=name,
        cam_from_world=pose,
        camera=camera,
        pixels=pixels,
        points=of_keypoints,
        normals=normals,
        sides=sides,
        seen=points,
    )


_UPPER = np.triu_indices(3)


def _equations(
    pixels: Points2D, points3D: Points3D, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> tuple[Float64[np.ndarray, "m 6"], Float64[np.ndarray, "m 3"]]:
    """What each observation adds to the normal equations of its point."""
    world_from_cam = cam_from_world.inverse()
    rays = np.column_stack([np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2), np.ones(len(pixels))])
    rays = rays @ world_from_cam.rotation.matrix().T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    away = np.eye(3) - rays[:, :, None] * rays[:, None]
    distances = np.linalg.norm(points3D - world_from_cam.translation, axis=1)
    away *= (camera.mean_focal_length() / np.maximum(distances, 1e-12))[:, None, None] ** 2
    return away[:, _UPPER[0], _UPPER[1]], away @ world_from_cam.translation


def _solved(
    normals: Float64[np.ndarray, "n 6"], sides: Float64[np.ndarray, "n 3"], counts: Ids
) -> Float64[np.ndarray, "n 3"]:
    """The points that solve normal equations; NaN where too few rays or nearly parallel ones meet."""
    places = np.full((len(normals), 3), np.nan)
    full = np.zeros((len(normals), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = normals
    full[:, _UPPER[1], _UPPER[0]] = normals
    values = np.linalg.eigvalsh(full)
    good: Mask = (counts >= _NEED) & (values[:, 0] > np.sin(_MIN_ANGLE / 2) ** 2 * values[:, 2])
    places[good] = np.linalg.solve(full[good], sides[good][:, :, None])[:, :, 0]
    return places


def _pairs_by_image(names: Sequence[str], matches: Matches) -> list[list[tuple[int, IndexPairs]]]:
    """For each image the others and (own keypoint, other keypoint), those with the most matches first."""
    index = {name: i for i, name in enumerate(names)}
    found: dict[int, list[tuple[int, IndexPairs]]] = defaultdict(list)
    for a, b in sorted(matches):
        if a in index and b in index:
            rows = np.asarray(matches[a, b], np.int64).reshape(-1, 2)
            found[index[a]].append((index[b], rows))
            found[index[b]].append((index[a], rows[:, ::-1]))
    return [sorted(found[i], key=lambda one: (-len(one[1]), one[0])) for i in range(len(names))]
