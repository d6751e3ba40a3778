"""Sets of reference images to keep: dominating sets, orders of all images, and random images.

A dominating set and the points it sees are the X' and P' of the paper [1].

References:
    [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csc_array, csr_array

from slimsfm.domination import SOLVERS, DominationProblem, Solution, cover_order
from slimsfm.domination.local_search import least_error_by_swaps
from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images

_NEAR_DEG = 45.0  # between neighbors: if the next image is farther away, the capture ends here
_GAP_DEG = 120.0  # an image without neighbors in an angle this wide is at the rim
_INWARD_DEG = 10.0  # an image may stand for another if it is at most this much farther in
_RELIABLE = 0.9  # share of the image pairs within reach that localize each other
_CELLS = 4  # along each edge of the box
_MIN_POINTS = 20  # of a cell that is a part of the surface
_SHARE = 0.5  # of the most points of a cell that any image sees

Directions = Float64[np.ndarray, "n 3"]
Member = Bool[np.ndarray, " n"]


def rim_groups(map: Map, adjacency: csr_array) -> csr_array:
    """Find groups of images, of each of which one must be kept so that queries at the rim find references.

    Args:
        map: The map.
        adjacency: Entry [u, v] is true where image u localizes image v, in order of the map's names.

    Returns:
        Boolean matrix with one row per group and one column per image; no group is empty or occurs twice.
    """
    rows = [*rim_sectors(viewing_directions(map), adjacency), *surface_parts(map)]
    groups = np.array(rows, dtype=bool).reshape(-1, len(map.images))
    return csr_array(np.unique(groups, axis=0))


def viewing_directions(map: Map) -> Directions:
    """Unit vectors from the center of the box to the cameras, in order of name."""
    eyes = np.array([image.projection_center() for image in map.images.values()]) - map.box.center
    return eyes / np.maximum(np.linalg.norm(eyes, axis=1, keepdims=True), 1e-12)


def rim_sectors(directions: Directions, adjacency: csr_array) -> Iterator[Member]:
    """For each image at the rim, and each of its open sides, the images that can stand for it.

    An image is at the rim if its neighbors, the images within 45 degrees, leave an angle of 120 degrees or
    more empty; the middle of that angle is outward. The images that can stand for it localize it, are at most
    10 degrees farther in, and are within the reach of the map: the angle within which nine of ten pairs of
    images localize each other. An image without neighbors is not at the rim.

    Images all around an object, as on a sphere, have no rim; those on a ring have one above and one below.

    Args:
        directions: From the object to the cameras.
        adjacency: Entry [u, v] is true where image u localizes image v.
    """
    dominators = csc_array(adjacency)
    reach_deg = reach(directions, adjacency)
    for i, here in enumerate(directions):
        angles_deg, ways = _angles_deg(directions, i), _ways(here, directions)
        neighbors = np.flatnonzero((angles_deg <= _NEAR_DEG) & ways.any(axis=1))
        localizes = np.zeros(len(directions), dtype=bool)
        localizes[dominators.indices[dominators.indptr[i] : dominators.indptr[i + 1]]] = True
        for outward in _outward(ways[neighbors]):
            members = localizes & (angles_deg <= reach_deg) & (angles_deg * (ways @ outward) >= -_INWARD_DEG)
            members[i] = True
            yield members


def reach(directions: Directions, adjacency: csr_array) -> int:
    """The largest angle in degrees within which nine of ten pairs of images localize each other, or 0."""
    pairs, edges = np.zeros((2, 181))
    for i in range(len(directions)):
        degrees = np.ceil(_angles_deg(directions, i)).astype(np.int64)
        others = adjacency.indices[adjacency.indptr[i] : adjacency.indptr[i + 1]]
        pairs += np.bincount(np.delete(degrees, i), minlength=181)
        edges += np.bincount(degrees[others[others != i]], minlength=181)
    reliable = np.cumsum(edges) >= _RELIABLE * np.maximum(np.cumsum(pairs), 1)
    return int(np.flatnonzero(reliable).max(initial=0))


def _angles_deg(directions: Directions, i: int) -> Float64[np.ndarray, " n"]:
    return np.degrees(np.arccos(np.clip(directions @ directions[i], -1, 1)))


def _ways(here: np.ndarray, directions: Directions) -> Float64[np.ndarray, "n 2"]:
    """Unit vectors along the sphere from a direction to all others; 0 where they coincide."""
    flat = directions @ np.linalg.svd(here[None])[2][1:].T
    lengths = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.where(lengths > 1e-9, flat / np.maximum(lengths, 1e-9), 0.0)


def _outward(ways: Float64[np.ndarray, "k 2"]) -> Iterator[np.ndarray]:
    """The middles of the wide angles without any neighbor."""
    if len(ways) == 0:
        return
    bearings = np.sort(np.arctan2(ways[:, 1], ways[:, 0]))
    gaps = np.diff(np.append(bearings, bearings[0] + 2 * np.pi))
    for place in np.flatnonzero(gaps >= np.radians(_GAP_DEG)):
        middle = bearings[place] + gaps[place] / 2
        yield np.array([np.cos(middle), np.sin(middle)])


def surface_parts(map: Map) -> Iterator[Member]:
    """For each part of the object's surface, the images that see much of it.

    The box is divided into 4 x 4 x 4 cells. A cell with 20 points or more is a part of the surface. An image
    sees much of it if it sees at least half of the most points of the cell that any image sees.
    """
    cells = _cells(map.points3D_in_world, map.box)
    count = _CELLS**3
    sizes = np.bincount(cells, minlength=count + 1)[:count]
    seen = np.array(
        [np.bincount(cells[np.unique(o.points)], minlength=count + 1) for o in map.observations.values()]
    )
    for cell in np.flatnonzero(sizes >= _MIN_POINTS):
        most = seen[:, cell].max()
        if most > 0:
            yield seen[:, cell] >= _SHARE * most


def _cells(points: np.ndarray, box: Box) -> np.ndarray:
    """Index of the cell of the box that contains each point; one past the last if it is outside."""
    along = (points - box.center) @ np.linalg.pinv(box.half_edges)
    place = np.floor((along + 1) / 2 * _CELLS).astype(np.int64)
    inside = np.all((place >= 0) & (place < _CELLS), axis=1)
    return np.where(inside, place @ [_CELLS**2, _CELLS, 1], _CELLS**3)


Cost = Literal["image", "observations"]

_PAPER = "random"  # the solver whose sets are not improved by swaps


@dataclass(frozen=True, kw_only=True)
class DominatingSetOptions:
    """How a dominating set of the reference images is chosen."""

    threshold: float = 0.05
    """Largest relative corner error of a pose for which an image counts as localized."""

    solver: str = "exact"
    """Solver: "exact" (proven minimum), "cpsat" (the same for thousands of images, with OR-Tools), "greedy"
    (fast) or "random" (the paper's)."""

    seed: int = 0
    """Seed of all random choices."""

    dominators: int = 1
    """Number of kept images that localize each image that is not kept, or all that can if they are fewer."""

    rim: bool = False
    """Localize the images at the rim of the capture from images nearly as far out, and keep an image of each
    part of the object's surface: queries at the rim have reference images on one side only."""

    cost: Cost = "image"
    """What to minimize: the number of kept images, or of their observations, which determines memory and the
    time of exhaustive matching."""

    max_images: int | None = None
    """Largest number of images. If it is too small to localize all others, as many as possible are."""

    best: bool = False
    """Find the set with the proven least sum of errors among the smallest sets, which may take a minute for
    50 images. Otherwise swaps reduce the sum quickly. The sets of the paper's solver are not improved."""

    def __post_init__(self) -> None:
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(sorted(SOLVERS))}, got {self.solver!r}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.dominators < 1:
            raise ValueError(f"dominators must be at least 1, got {self.dominators}")
        if self.cost not in get_args(Cost):
            raise ValueError(f"cost must be one of {', '.join(get_args(Cost))}, got {self.cost!r}")
        if self.max_images is not None and self.max_images < 1:
            raise ValueError(f"max_images must be at least 1, got {self.max_images}")
        if self.max_images is not None and self.cost != "image":
            raise ValueError(f"max_images limits a number of images: cost must be image, got {self.cost!r}")


def dominating_set(graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None = None) -> Solution:
    """Choose images that localize all others, as indices into the graph's names.

    Args:
        graph: The reference graph.
        options: How to choose. A limit on the images that is large enough has no effect.
        map: The map of the graph; only `rim` and costs other than "image" need it. Images whose poses it
            marks as wrong localize no others, and no image is kept to localize them.

    Returns:
        The images. Optimality refers to their number or cost; to their errors only with `best`.

    Raises:
        ValueError: The options need the map, or the graph belongs to another map.
    """
    graph = _without_wrong(graph, map)
    problem = _problem(graph, options, map)
    found = SOLVERS[options.solver](problem, seed=options.seed)
    if options.max_images is not None and len(found.chosen) > options.max_images:
        problem = _problem(graph, options, map, budget=options.max_images)
        found = SOLVERS[options.solver](problem, seed=options.seed)
    if options.best or options.solver == _PAPER:
        return found
    chosen = least_error_by_swaps(_with_errors(problem, graph), found.chosen)
    return replace(found, chosen=chosen, cost=problem.cost(chosen), unmet=problem.num_unmet(chosen))


def image_order(
    graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None = None
) -> tuple[str, ...]:
    """Order all images such that each prefix localizes nearly as many others as any set of its size.

    The dominating set comes first, then images that localize others a second time, a third time and so on.

    Args:
        graph: The reference graph.
        options: How the dominating set is chosen, and what an image costs.
        map: The map of the graph; only `rim` and costs other than "image" need it.

    Raises:
        ValueError: The options need the map, or the graph belongs to another map.
    """
    graph = _without_wrong(graph, map)
    first = dominating_set(graph, options, map).chosen
    order = cover_order(_problem(graph, options, map), first=first)
    return tuple(graph.names[i] for i in order)


def images_within(order: tuple[str, ...], fits: Callable[[tuple[str, ...]], bool]) -> tuple[str, ...]:
    """The longest prefix of an order of images that is within a limit, such as bytes or points.

    Args:
        order: Names, the most important first.
        fits: Whether images are within the limit. If a prefix is not, no longer one may be.

    Returns:
        The first names, in order; empty if the first one alone exceeds the limit.

    Notes:
        Bisection: `fits` is called about log2(len(order)) times.
    """
    fitting, too_many = 0, len(order) + 1
    while too_many - fitting > 1:
        middle = (fitting + too_many) // 2
        if fits(order[:middle]):
            fitting = middle
        else:
            too_many = middle
    return order[:fitting]


def _without_wrong(graph: ReferenceGraph, map: Map | None) -> ReferenceGraph:
    """A graph in which images of wrong pose localize none, and nothing must be kept to localize them."""
    wrong = np.isin(graph.names, map.info.wrong_poses if map else ())
    if not wrong.any() or wrong.all():
        return graph
    errors = graph.dense()
    errors[wrong] = np.inf
    errors[np.ix_(~wrong, wrong)] = 0.0
    pairs = np.argwhere(~np.eye(len(wrong), dtype=bool))
    return ReferenceGraph.from_errors(graph.names, pairs, errors[pairs[:, 0], pairs[:, 1]])


def _problem(
    graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None, budget: int | None = None
) -> DominationProblem:
    if map is not None and graph.names != tuple(map.images):
        raise ValueError("graph must have the images of this map, but it has others")
    adjacency = graph.adjacency(options.threshold)
    return DominationProblem(
        adjacency,
        costs=_costs(options, map),
        dominators=options.dominators,
        budget=budget,
        groups=_groups(adjacency, options, map),
        errors=graph.errors if options.best and options.solver != _PAPER else None,
    )


def _with_errors(problem: DominationProblem, graph: ReferenceGraph) -> DominationProblem:
    return DominationProblem(
        problem.adjacency,
        costs=problem.costs,
        dominators=problem.dominators,
        budget=problem.budget,
        groups=problem.groups,
        errors=graph.errors,
    )


def _costs(options: DominatingSetOptions, map: Map | None) -> np.ndarray | None:
    if options.cost == "image":
        return None
    if map is None:
        raise ValueError(f"map must be given where cost is {options.cost!r}")
    return np.array([max(len(seen.rows), 1) for seen in map.observations.values()], np.float64)


def _groups(adjacency: csr_array, options: DominatingSetOptions, map: Map | None) -> csr_array | None:
    if not options.rim:
        return None
    if map is None:
        raise ValueError("map must be given where rim is set")
    return rim_groups(map, adjacency)


def keep_random_images(map: Map, count: int, *, seed: int) -> Map:
    """Keep this many images drawn at random, and the points they see: the baseline of the paper.

    Raises:
        InputError: The map has fewer images, or `count` is not positive.
    """
    names = list(map.images)
    if not 1 <= count <= len(names):
        raise InputError(f"{count} random images cannot be drawn from the {len(names)} of the map")
    chosen = np.random.default_rng(seed).choice(len(names), size=count, replace=False)
    return keep_images(map, (names[i] for i in chosen))
