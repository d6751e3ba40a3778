"""Forget points that nothing matches any more and images that others replace, and say what that costs."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from slimsfm.arrays import Ids, evenly_spaced
from slimsfm.domination import DominationProblem, cover_order, greedy
from slimsfm.errors import InputError
from slimsfm.geometry import ADD_FRACTIONS, corner_error
from slimsfm.graph import GraphOptions, ReferenceGraph, compute_graph
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.mapping.descriptors import descriptor_length
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.add import check_extendable
from slimsfm.upkeep.missed_points import count_misses
from slimsfm.upkeep.origins import focal_origins, with_count

_TESTS = 16  # images that are left out to measure what is lost


@dataclass(frozen=True, kw_only=True)
class ForgetOptions:
    """What a map forgets besides points that are missed."""

    max_images: int | None = None
    """Largest number of images. Those are dropped first that others replace; of equal ones, the older."""

    def __post_init__(self) -> None:
        if self.max_images is not None and self.max_images < 2:
            raise ValueError(f"max_images must be at least 2, got {self.max_images}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Forgetting:
    """What a map forgets, and what that costs."""

    map: Map
    """The map without it; the map itself if nothing is forgotten."""

    images: tuple[str, ...]
    """Names of the images that are dropped, sorted."""

    missed_points: Ids
    """Ids of the points that images which should see them never match."""

    orphaned_points: int
    """Number of further points that fewer than two of the kept images see."""

    tests: tuple[str, ...]
    """Images that were localized without themselves: the dropped ones, or some of all if none is dropped."""

    before: float
    """Percentage of them that the map localizes to a tenth of the diagonal."""

    after: float
    """The same without what is forgotten."""


def forget(
    map: Map,
    options: ForgetOptions = ForgetOptions(),
    *,
    graph: ReferenceGraph | None = None,
    progress: ProgressBar = silent,
) -> Forgetting:
    """Choose what a map can forget, and measure what that costs.

    Points are forgotten that at least three images miss although others see them from nearly the same place
    (`count_misses`). Above `max_images`, images are kept in the order in which they localize others, by the
    reference graph, and newer before older ones. Nothing that is kept moves.

    Args:
        map: A full map of keypoints.
        options: What else to forget.
        graph: The reference graph of the map; None: computed if it is needed.
        progress: Progress callback.

    Raises:
        InputError: The graph is of other images, or nothing would be left.
        MapError: The map was reduced, or built without a detector.
    """
    check_extendable(map)
    descriptor_length(map)  # a map whose parts differ fails here and not half-way
    missed = map.point3D_ids[count_misses(map, progress).forgettable()]
    kept = _kept_images(map, options, graph)
    dropped = tuple(name for name in map.images if name not in kept)
    remaining = _without(map, kept, missed) if dropped or len(missed) else map
    left = set(remaining.point3D_ids.tolist())
    orphaned = len(set(map.point3D_ids.tolist()) - left - set(missed.tolist()))
    names = dropped or tuple(map.images)
    tests = tuple(names[place] for place in evenly_spaced(len(names), _TESTS))
    before, after = 0, 0
    for name in progress(list(tests), "localize images that are left out"):
        before += _localizes(map, name)
        after += _localizes(remaining, name, map)
    return Forgetting(
        map=remaining,
        images=dropped,
        missed_points=missed,
        orphaned_points=orphaned,
        tests=tests,
        before=100 * before / max(len(tests), 1),
        after=100 * after / max(len(tests), 1),
    )


def _kept_images(map: Map, options: ForgetOptions, graph: ReferenceGraph | None) -> Collection[str]:
    if options.max_images is None or options.max_images >= len(map.images):
        return list(map.images)
    if graph is None:
        graph = compute_graph(map).graph
    if graph.names != tuple(map.images):
        raise InputError("the graph is of other images than the map")
    newest = sorted(range(len(graph.names)), key=lambda row: -map.images[graph.names[row]].image_id)
    edges = graph.adjacency(GraphOptions().threshold)[newest][:, newest]
    problem = DominationProblem(edges)
    order = cover_order(problem, first=greedy(problem).chosen)
    return {graph.names[newest[place]] for place in order[: options.max_images]}


def _without(map: Map, kept: Collection[str], missed: Ids) -> Map:
    """The map of some images, without some points."""
    slim = keep_images(map, kept, min_track_length=2) if len(kept) < len(map.images) else map
    model = pycolmap.Reconstruction(slim.model)
    for point_id in np.intersect1d(missed, slim.point3D_ids).tolist():
        model.delete_point3D(point_id)
    if not model.num_points3D():
        raise InputError("the images that would be kept have no point in common; keep more of them")
    smaller = replace(slim, model=model)
    old, gone = map.info, len(map.images) - len(smaller.images)
    info = replace(
        old,
        quality=old.quality and _quality(old.quality, smaller, focal_origins(map)),
        origin=with_count(old.origin, gone, "images forgotten"),
    )
    return replace(smaller, info=info)


def _quality(old: ModelQuality, smaller: Map, origins: Mapping[str, str]) -> ModelQuality:
    """Quality, measured again; what was said of kept images stays, because they did not move."""
    names = smaller.images
    found = measure(smaller.model, smaller.matches, list(names))
    return replace(
        found.with_origins(origins),
        given=old.given,
        contradictions={name: share for name, share in old.contradictions.items() if name in names},
        doubtful=tuple(name for name in old.doubtful if name in names),
        ambiguous=old.ambiguous,
    )


def _localizes(map: Map, name: str, source: Map | None = None) -> bool:
    """Whether a map without an image localizes it; `source` has the image if the map does not."""
    source = source or map
    others = [one for one in map.images if one != name]
    left = keep_images(map, others, min_track_length=2) if name in map.images else map
    if not len(left.point3D_ids):
        return False
    localizer = Localizer(left, LocalizationOptions(min_confidence=0.0))
    pose = localizer.search(source.features[name], source.camera(name)).best.pose
    true = source.images[name].cam_from_world()
    return pose is not None and corner_error(pose.cam_from_world, true, source.box) < ADD_FRACTIONS[0]
