"""Subsets of verified pairs without most pairs of look-alike parts."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree

from slimsfm.arrays import Points2D
from slimsfm.mapping.pairs import Matches, in_order
from slimsfm.mapping.support import Pair

_PER_IMAGE = 2  # strongest pairs of each image, beyond the spanning tree
_LEAST_COVERAGE = 0.18


def neighbors(matches: Matches, names: list[str], *, overlap: int) -> set[Pair]:
    """Pairs of images that are at most `overlap` apart in order of name."""
    place = {name: number for number, name in enumerate(in_order(names))}
    return {(a, b) for a, b in matches if abs(place[a] - place[b]) <= overlap}


def strongest(matches: Matches, names: list[str]) -> set[Pair]:
    """A spanning tree of the pairs with the most matches, and the two strongest pairs of each image."""
    rows = {name: row for row, name in enumerate(names)}
    pairs = sorted(matches)
    if not pairs:
        return set()
    counts = {pair: len(matches[pair]) for pair in pairs}
    ends = np.array([[rows[a], rows[b]] for a, b in pairs]).T
    weights = csr_array(
        (np.array([-float(counts[pair]) for pair in pairs]), (ends[0], ends[1])), shape=(len(names),) * 2
    )
    tree = minimum_spanning_tree(weights).tocoo()
    chosen = {
        (min(names[i], names[j]), max(names[i], names[j]))
        for i, j in zip(tree.row.tolist(), tree.col.tolist(), strict=True)
    }
    of_image: dict[str, list[Pair]] = defaultdict(list)
    for pair in pairs:
        for name in pair:
            of_image[name].append(pair)
    for own in of_image.values():
        chosen.update(sorted(own, key=lambda pair: (-counts[pair], pair))[:_PER_IMAGE])
    return chosen


def wide(matches: Matches, keypoints: Mapping[str, Points2D]) -> set[Pair]:
    """Pairs whose matches spread over 18 % of what all keypoints spread over, in both images.

    Look-alike prints match; their surroundings do not.
    """
    whole = {name: _hull_area(pixels) for name, pixels in keypoints.items()}
    return {
        (a, b)
        for a, b in matches
        if min(
            _hull_area(keypoints[name][matches[a, b][:, column]]) / max(whole[name], 1.0)
            for column, name in enumerate((a, b))
        )
        >= _LEAST_COVERAGE
    }


def _hull_area(pixels: Points2D) -> float:
    from scipy.spatial import ConvexHull, QhullError  # slow to import, and rarely needed

    try:
        return float(ConvexHull(pixels).volume) if len(pixels) > 2 else 0.0
    except QhullError:  # all on one line
        return 0.0
