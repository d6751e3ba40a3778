"""Which points of two maps in one frame are the same, and the model of both.

Two points are the same if one keypoint sees both: a keypoint of an image that both maps have, or one of an
image of the one map that is localized in the other. Points that are joined keep the position that they have
in the first map, and observations of the second map join their tracks.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Ids, IndexPairs, Mask
from slimsfm.errors import InputError
from slimsfm.features import shrink_factor
from slimsfm.localization import Localizer
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import MIN_COMMON_POINTS
from slimsfm.progress import ProgressBar, silent

_SPREAD = 3.0  # times the median error of all votes: points that are further apart are not joined
_LEAST_PX, _MOST_PX = 4.0, 12.0  # limits of that, in the pixels in which features were found
_LEAST_SHARE = 0.5  # of the votes, that must be within the largest limit


@dataclass(frozen=True, kw_only=True, eq=False)
class SamePoints:
    """Points of two maps that are the same."""

    first: Ids
    """Ids of points of the first map; each once."""

    second: Ids
    """Ids of the same points in the second map; each once."""


def same_points(
    first: Map, second: Map, shared: Mapping[str, str], *, progress: ProgressBar = silent
) -> SamePoints:
    """Find points that two maps in one frame have in common.

    Args:
        first: A map.
        second: Another map, moved into its frame.
        shared: Images of the second map that the first one has too: its name there by that in the second map.
        progress: Progress callback.

    Raises:
        InputError: Most of what both maps see contradicts their poses, or too few points are the same.
    """
    votes = _votes(first, second, shared, progress)
    pairs = np.array(sorted(votes, key=lambda pair: (-votes[pair], pair)), np.int64).reshape(-1, 2)
    errors = _errors(first, second, pairs)
    close = errors < _MOST_PX
    if len(pairs) < MIN_COMMON_POINTS or close.mean() < _LEAST_SHARE:
        raise InputError(
            f"what the two maps have in common contradicts itself: {int(close.sum())} of {len(pairs)} common "
            "points are where both say; the maps are not of one place, or one of them is wrong (`slimsfm "
            "check`)"
        )
    limit = np.clip(_SPREAD * np.median(errors), _LEAST_PX, _MOST_PX)
    kept = pairs[_first_of_each(pairs, errors <= limit)]
    if len(kept) < MIN_COMMON_POINTS:
        raise InputError(f"only {len(kept)} points of the two maps are the same; use maps that share more")
    return SamePoints(first=kept[:, 0], second=kept[:, 1])


def _votes(
    first: Map, second: Map, shared: Mapping[str, str], progress: ProgressBar
) -> Counter[tuple[int, int]]:
    """Number of keypoints that see a point of each map, by pair of ids."""
    votes: Counter[tuple[int, int]] = Counter()
    localizer = Localizer(first)
    ids = {tuple(xyz): int(i) for i, xyz in zip(first.point3D_ids, first.points3D_in_world, strict=True)}
    for name in progress(list(second.images), "find common points"):
        seen = _seen_rows(second, name)
        if name in shared:
            other = _seen_rows(first, shared[name])
        else:
            other = _rows_by_localizing(localizer, second, name, ids)
        votes.update((other[row], seen[row]) for row in other.keys() & seen.keys())
    return votes


def _seen_rows(map: Map, name: str) -> dict[int, int]:
    """The id of the point that each keypoint of an image sees."""
    seen = map.observations[name]
    return dict(zip(seen.rows.tolist(), map.point3D_ids[seen.points].tolist(), strict=True))


def _rows_by_localizing(
    localizer: Localizer, second: Map, name: str, ids: Mapping[tuple, int]
) -> dict[int, int]:
    """The same by localizing an image in another map."""
    features = second.features[name]
    found = localizer.localize_features(features, second.camera(name))
    if found.pose is None:
        return {}
    rows = {tuple(pixel): row for row, pixel in enumerate(features.keypoints.astype(np.float64))}
    pixels, points = found.points2D[found.pose.inliers], found.points3D_in_world[found.pose.inliers]
    return {
        rows[tuple(pixel)]: ids[tuple(point)]
        for pixel, point in zip(pixels, points, strict=True)
        if tuple(pixel) in rows
    }


def _errors(first: Map, second: Map, pairs: IndexPairs) -> Float64[np.ndarray, " n"]:
    """How far each pair of points is apart in the images that see one of them: the median, in pixels."""
    found = []
    for one, other in pairs.tolist():
        distances = [
            *_distances(second, other, first.model.point3D(one).xyz),
            *_distances(first, one, second.model.point3D(other).xyz),
        ]
        found.append(float(np.median(distances)))
    return np.array(found, np.float64)


def _distances(map: Map, point_id: int, xyz: Float64[np.ndarray, "3"]) -> list[float]:
    """Distances in pixels between keypoints that see a point and the projections of a position."""
    distances = []
    for element in map.model.point3D(point_id).track.elements:
        image = map.model.image(element.image_id)
        camera = map.model.camera(image.camera_id)
        factor = shrink_factor(map.info.extractor_options, camera.width, camera.height)
        pixel = image.project_point(xyz)
        apart = np.inf if pixel is None else np.linalg.norm(pixel - image.points2D[element.point2D_idx].xy)
        distances.append(float(apart / factor))
    return distances


def _first_of_each(pairs: IndexPairs, allowed: Mask) -> list[int]:
    """Rows of allowed pairs, in this order, whose points are in no pair before."""
    taken: tuple[set[int], set[int]] = set(), set()
    kept = []
    for row in np.flatnonzero(allowed).tolist():
        one, other = pairs[row].tolist()
        if one not in taken[0] and other not in taken[1]:
            taken[0].add(one)
            taken[1].add(other)
            kept.append(row)
    return kept


def add_points(
    model: pycolmap.Reconstruction, second: Map, same: SamePoints, image_ids: Mapping[int, int]
) -> None:
    """Add the points and observations of a map to a model in its frame, in place.

    Args:
        model: The model of the first map, with the images of the second one.
        second: The second map.
        same: Points that are in both.
        image_ids: Id in the model by that in the second map.
    """
    joined = dict(zip(same.second.tolist(), same.first.tolist(), strict=True))
    following = count(1 + max(model.point3D_ids(), default=0))
    for point_id in second.point3D_ids.tolist():
        point = second.model.point3D(point_id)
        free = _free(model, point.track, image_ids)
        if point_id in joined:
            for element in free:
                model.add_observation(joined[point_id], element)
        elif len(free) >= 2:
            made = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
            made.track = pycolmap.Track(free)
            model.add_point3D_with_id(next(following), made)


def _free(
    model: pycolmap.Reconstruction, track: pycolmap.Track, image_ids: Mapping[int, int]
) -> list[pycolmap.TrackElement]:
    """The observations of a track by keypoints of the model that see no point yet."""
    elements = sorted((image_ids[one.image_id], one.point2D_idx) for one in track.elements)
    return [
        pycolmap.TrackElement(image_id, row)
        for image_id, row in elements
        if not model.image(image_id).points2D[row].has_point3D()
    ]
