"""Images that do not match what they should see: they were laid over a place that looks alike.

Where Structure from Motion lays look-alike parts over each other, the images there confirm each other by what
looks alike. What does not look alike gives them away: of the points that the images next to them see, they
match few, and many of their matches with these images contradict the map. An image of a right map may also
match few points, because something hides them, but its matches agree. Only images are in doubt that pairs
which are hard to doubt (`mapping.support`) contradict, or that such pairs join with these.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import networkx as nx
import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from slimsfm.arrays import IndexPairs, Mask
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.support import MIN_AGREEING, Pair, trusted_pairs
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.findings import Misplaced
from slimsfm.upkeep.missed_points import points_in_view

_NEIGHBORS = 20  # images that an image is compared with: those with the nearest cameras
_FEWEST = 30  # points of a pair of images that one of them should see
_MATCHED = 0.3  # share of these below which an image may be misplaced
_AGREEING = 0.6  # share of its matches with the images around it below which it may be
_PART_MATCHED = 0.2  # as above, of parts: blaming many images takes more

Sums = Float64[np.ndarray, " n"]
"""A sum by image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pairs:
    """Pairs of images that should see points in common, in both orders."""

    images: IndexPairs
    """Rows of the images."""

    expected: Sums
    """How many points of the one the other should see, or the reverse, whichever is more."""

    matched: Sums
    """Number of verified matches."""

    agreeing: Sums
    """Number of these that agree with the map."""

    @property
    def weights(self) -> tuple[Sums, Sums, Sums, Sums]:
        """By pair, what `sums` adds up."""
        return self.expected, np.minimum(self.expected, self.agreeing), self.matched, self.agreeing

    def sums(self, kept: Mask) -> tuple[Sums, Sums, Sums, Sums]:
        """By image, over its pairs with images that are kept.

        Returns:
            Points that it should see, how many of them it matches, matches, and matches that agree.
        """
        inside = kept[self.images[:, 1]]
        rows = self.images[inside, 0]
        found = np.zeros((4, len(kept)))
        for total, weight in zip(found, self.weights, strict=True):
            np.add.at(total, rows, weight[inside])
        return found[0], found[1], found[2], found[3]


class Surroundings:
    """What the images of a map should see of those around them, and what they match of it.

    Args:
        map: A full map.
        matches: Verified matches.
        agreeing: Share of the matches of each pair that agree with the map.
        progress: Progress callback.
    """

    def __init__(
        self, map: Map, matches: Matches, agreeing: Mapping[Pair, float], progress: ProgressBar = silent
    ) -> None:
        self._map, self._matches, self._agreeing, self._progress = map, matches, agreeing, progress

    @cached_property
    def _pairs(self) -> _Pairs:
        return _pairs(self._map, self._matches, self._agreeing, self._progress)

    def misplaced(self, wrong: Collection[str]) -> tuple[Misplaced, ...]:
        """Find images in doubt that match fewer than 30 % of what they should see, and contradict the map.

        The worst image is taken out first, and the others are compared without it. Then parts that confirm
        themselves are compared with the rest: those that match fewer than 20 % of what they should see of it,
        and of whose matches with it most contradict the map, are misplaced too. In the end, images come back
        that what is left confirms.

        Args:
            wrong: Images that are left out, because their poses are known to be wrong.
        """
        names = list(self._map.images)
        right = np.array([name not in wrong for name in names])
        doubted = _doubted(names, self._matches, self._agreeing, wrong)
        if not doubted.any():
            return ()
        kept = _without_parts(self._pairs, _without_images(self._pairs, right, doubted))
        expected, seen, matched, agreed = self._pairs.sums(kept)
        kept |= (seen > _MATCHED * expected) & (agreed > MIN_AGREEING * matched)
        return tuple(
            Misplaced(
                name=names[i],
                expected=int(expected[i]),
                seen=int(seen[i]),
                matches=int(matched[i]),
                agreeing=float(agreed[i] / max(matched[i], 1)),
            )
            for i in np.flatnonzero(right & ~kept).tolist()
        )


def _doubted(
    names: list[str], matches: Matches, agreeing: Mapping[Pair, float], wrong: Collection[str]
) -> Mask:
    """Which images trusted pairs that agree join with one that a trusted pair contradicts.

    In a right map of what looks alike, many pairs contradict the map, but not those that are hard to doubt.
    """
    graph, broken = nx.Graph(), set()
    graph.add_nodes_from(names)
    for pair in sorted(trusted_pairs(matches, names)):
        if set(pair) & set(wrong):
            continue
        if agreeing.get(pair, 1.0) >= MIN_AGREEING:
            graph.add_edge(*pair)
        else:
            broken.update(pair)
    doubted = {name for part in nx.connected_components(graph) if part & broken for name in part}
    return np.array([name in doubted for name in names])


def _pairs(map: Map, matches: Matches, agreeing: Mapping[Pair, float], progress: ProgressBar) -> _Pairs:
    names = list(map.images)
    centers = np.array([map.images[name].projection_center() for name in names])
    tree, most = KDTree(centers), min(_NEIGHBORS + 1, len(names))
    expected: dict[tuple[int, int], int] = {}
    for row in progress(list(range(len(names))), "compare images with those around"):
        for other in sorted(np.atleast_1d(tree.query(centers[row], most)[1]).tolist()):
            pair = (min(row, other), max(row, other))
            if row != other:
                count = len(points_in_view(map, names[row], names[other]))
                expected[pair] = max(expected.get(pair, 0), count)
    rows = np.array(sorted(pair for pair in expected if expected[pair] >= _FEWEST), np.int64).reshape(-1, 2)
    keys = [(min(names[a], names[b]), max(names[a], names[b])) for a, b in rows.tolist()]
    counts = np.array([len(matches[key]) if key in matches else 0 for key in keys], np.float64)
    shares = np.array([agreeing.get(key, 0.0) for key in keys])
    return _Pairs(
        images=np.concatenate([rows, rows[:, ::-1]]),
        expected=np.tile([float(expected[a, b]) for a, b in rows.tolist()], 2),
        matched=np.tile(counts, 2),
        agreeing=np.tile(counts * shares, 2),
    )


def _without_images(pairs: _Pairs, right: Mask, doubted: Mask) -> Mask:
    """Which images are left when the worst one in doubt is taken out until none is misplaced."""
    kept = right.copy()
    while True:
        expected, seen, matched, agreeing = pairs.sums(kept)
        is_out = kept & doubted & (seen < _MATCHED * expected) & (agreeing < _AGREEING * matched)
        if not is_out.any():
            return kept
        shares = np.where(is_out, seen / np.maximum(expected, 1), np.inf)
        kept[np.argmin(shares)] = False


def _without_parts(pairs: _Pairs, kept: Mask) -> Mask:
    """Which images are left when the worst part is taken out until none is misplaced.

    Parts are what an edge of the spanning tree with the most agreeing matches separates from the rest.
    """
    left = kept.copy()
    while True:
        tree = _spanning_tree(pairs, left)
        expected, seen, matched, agreeing = _across(pairs, left, tree).T
        shares = np.where(agreeing < MIN_AGREEING * matched, seen / np.maximum(expected, 1), np.inf)
        if not len(shares) or shares.min() >= _PART_MATCHED:
            return left
        part = tree.smaller_side(tree.order[int(np.argmin(shares))])
        left[sorted(part)] = False


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tree:
    """Rooted trees that span images; each edge is named by its lower end."""

    graph: nx.DiGraph
    """Edges from the roots down."""

    order: list[int]
    """Images that have one above them, those first that come before all below them."""

    def smaller_side(self, top: int) -> set[int]:
        """The images of the smaller of the two parts that an edge joins."""
        below = {top, *nx.descendants(self.graph, top)}
        tree = nx.node_connected_component(self.graph.to_undirected(as_view=True), top)
        return min(below, tree - below, key=lambda side: (len(side), min(side)))


def _spanning_tree(pairs: _Pairs, kept: Mask) -> _Tree:
    inside = kept[pairs.images].all(axis=1)
    joined = nx.Graph()
    weights = zip(pairs.images[inside].tolist(), pairs.agreeing[inside].tolist(), strict=True)
    joined.add_weighted_edges_from((a, b, weight) for (a, b), weight in weights)
    spanning, rooted = nx.maximum_spanning_tree(joined), nx.DiGraph()
    for component in sorted(nx.connected_components(spanning), key=min):
        rooted.add_edges_from(nx.bfs_edges(spanning, min(component)))
    return _Tree(graph=rooted, order=[below for _, below in rooted.edges])


def _across(pairs: _Pairs, kept: Mask, tree: _Tree) -> Float64[np.ndarray, "edges 4"]:
    """For each edge of a tree, the sums over the pairs of images that it separates, as of `_Pairs.sums`.

    They are the sums of all images below, without the pairs of which both images are below: those that have
    their lowest common image above them there.
    """
    totals = np.stack(pairs.sums(kept), axis=1)
    inside = kept[pairs.images].all(axis=1) & (pairs.images[:, 0] < pairs.images[:, 1])
    values = np.stack([weight[inside] for weight in pairs.weights], axis=1)
    row = {(a, b): place for place, (a, b) in enumerate(pairs.images[inside].tolist())}
    joined, top_of_all = tree.graph.copy(), -1
    joined.add_edges_from((top_of_all, node) for node, degree in tree.graph.in_degree() if not degree)
    for (a, b), top in nx.tree_all_pairs_lowest_common_ancestor(joined, top_of_all, row) if row else ():
        totals[top] -= 2 * values[row[min(a, b), max(a, b)]]
    for below in reversed(tree.order):
        (above,) = tree.graph.predecessors(below)
        totals[above] += totals[below]
    return totals[tree.order]
