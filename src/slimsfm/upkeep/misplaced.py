"""Images that do not match what they should see: they were laid over a place that looks alike.

Where Structure from Motion lays look-alike parts over each other, the images there confirm each other by what
looks alike. What does not look alike gives them away: of the points that the images next to them see, they
match few, and many of their matches with these images contradict the map. An image of a right map may also
match few points, because something hides them, but its matches agree.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from slimsfm.arrays import IndexPairs, Mask
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.support import MIN_AGREEING, Pair
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
    """How many points of the one the other should see, or the reverse, whatever is more."""

    matched: Sums
    """Number of verified matches."""

    agreeing: Sums
    """Number of these that agree with the map."""

    def sums(self, kept: Mask) -> tuple[Sums, Sums, Sums, Sums]:
        """By image, over its pairs with images that are kept.

        Returns:
            Points that it should see, how many of them it matches, matches, and matches that agree.
        """
        inside = kept[self.images[:, 1]]
        rows = self.images[inside, 0]
        weights = self.expected, np.minimum(self.expected, self.agreeing), self.matched, self.agreeing
        found = np.zeros((4, len(kept)))
        for total, weight in zip(found, weights, strict=True):
            np.add.at(total, rows, weight[inside])
        return found[0], found[1], found[2], found[3]


def find_misplaced(
    map: Map,
    matches: Matches,
    agreeing: Mapping[Pair, float],
    wrong: Collection[str],
    progress: ProgressBar = silent,
) -> tuple[Misplaced, ...]:
    """Find images that match fewer than 30 % of what they should see, and whose matches contradict the map.

    The worst image is taken out first, and the others are compared without it. Then parts that confirm
    themselves are compared with the rest: those that match fewer than 20 % of what they should see of it, and
    of whose matches with it most contradict the map, are misplaced too. So are those that do not match what
    they should see of any other part, if their other matches with the largest part contradict the map.

    Args:
        map: A full map.
        matches: Verified matches.
        agreeing: Share of the matches of each pair that agree with the map.
        wrong: Images that are left out, because their poses are known to be wrong.
        progress: Progress callback.
    """
    names = list(map.images)
    pairs = _pairs(map, matches, agreeing, progress)
    right = np.array([name not in wrong for name in names])
    kept = _without_parts(pairs, _without_images(pairs, right))
    kept = _largest_part(names, pairs, kept, matches, agreeing)
    expected, seen, matched, agreed = pairs.sums(kept)
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


def _without_images(pairs: _Pairs, right: Mask) -> Mask:
    """Which images are left when the worst one is taken out until none is misplaced."""
    kept = right.copy()
    while True:
        expected, seen, matched, agreeing = pairs.sums(kept)
        is_out = kept & (seen < _MATCHED * expected) & (agreeing < _AGREEING * matched)
        if not is_out.any():
            return kept
        shares = np.where(is_out, seen / np.maximum(expected, 1), np.inf)
        kept[np.argmin(shares)] = False


def _without_parts(pairs: _Pairs, kept: Mask) -> Mask:
    """Which images are left when the worst part is taken out until none is misplaced.

    Parts are what an edge of the spanning tree with the most agreeing matches separates from the rest.
    """
    left = kept.copy()
    while parts := list(_parts(pairs, left)):
        shares = [_share_across(pairs, part, left) for part in parts]
        worst = int(np.argmin(shares))
        if shares[worst] >= _PART_MATCHED:
            break
        left &= ~parts[worst]
    return left


def _parts(pairs: _Pairs, kept: Mask) -> Iterator[Mask]:
    inside = kept[pairs.images].all(axis=1)
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(kept).tolist())
    weights = zip(pairs.images[inside].tolist(), pairs.agreeing[inside].tolist(), strict=True)
    graph.add_weighted_edges_from((a, b, weight) for (a, b), weight in weights)
    tree = nx.maximum_spanning_tree(graph)
    for a, b in sorted(tree.edges):
        tree.remove_edge(a, b)
        smaller = min(
            (nx.node_connected_component(tree, one) for one in (a, b)), key=lambda one: (len(one), min(one))
        )
        tree.add_edge(a, b)
        yield np.isin(np.arange(len(kept)), list(smaller))


def _share_across(pairs: _Pairs, part: Mask, kept: Mask) -> float:
    """Share of what a part should see of the rest that it matches; 1 if its matches agree with the map."""
    first, second = pairs.images.T
    across = part[first] & kept[second] & ~part[second]
    expected, seen = pairs.expected[across].sum(), np.minimum(pairs.expected, pairs.agreeing)[across].sum()
    contradicts = pairs.agreeing[across].sum() < MIN_AGREEING * pairs.matched[across].sum()
    return float(seen / expected) if contradicts else 1.0


def _largest_part(
    names: list[str], pairs: _Pairs, kept: Mask, matches: Matches, agreeing: Mapping[Pair, float]
) -> Mask:
    """Which images are left without the parts that contradict the largest one, whatever they should see."""
    holds = (pairs.agreeing >= _MATCHED * pairs.expected) & (pairs.agreeing >= MIN_AGREEING * pairs.matched)
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(kept).tolist())
    graph.add_edges_from(pairs.images[holds & kept[pairs.images].all(axis=1)].tolist())
    parts = sorted(nx.connected_components(graph), key=lambda part: (-len(part), min(part)))
    largest = {names[i] for i in parts[0]} if parts else set()
    left = kept.copy()
    for part in parts[1:]:
        own = {names[i] for i in part}
        across = [p for p in agreeing if len(own & set(p)) == 1 and len(largest & set(p)) == 1]
        total = sum(len(matches[p]) for p in across)
        if sum(agreeing[p] * len(matches[p]) for p in across) < _AGREEING * total:
            left[sorted(part)] = False
    return left
