"""Parts of a map that hang together by a thread, and what contradicts them.

Images are joined by the matches that agree with the map. The strongest links that join all images are the
maximum spanning tree. A link of the tree is a thread if it is much weaker than an image's best link usually
is, and if both sides have several images: no other pair across has more matches.
"""

from collections.abc import Collection, Iterator, Mapping

import networkx as nx
import numpy as np

from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.support import MIN_AGREEING, Pair
from slimsfm.upkeep.findings import Thread

_FEWEST = 4  # images of a part
_WEAK = 0.15  # of the matches that the best neighbor of an image usually has
_STRONG = 15  # matches of a pair that may contradict


def find_threads(
    names: Collection[str], matches: Matches, agreeing: Mapping[Pair, float], wrong: Collection[str]
) -> tuple[Thread, ...]:
    """Find the parts that little holds together, without the images whose poses are wrong.

    Args:
        names: The images of the map.
        matches: Verified matches.
        agreeing: Share of the matches of each pair that agree with the map.
        wrong: Images that are left out.
    """
    graph = _joined(sorted(set(names) - set(wrong)), matches, agreeing)
    best = [max((d["count"] for *_, d in graph.edges(name, data=True)), default=0) for name in graph]
    usual = int(np.median(best or [0]))
    tree = nx.maximum_spanning_tree(graph, weight="count")
    weak = sorted((d["count"], a, b) for a, b, d in tree.edges(data=True) if d["count"] < _WEAK * usual)
    found = []
    for count, a, b in weak:
        tree.remove_edge(a, b)
        sides = [nx.node_connected_component(tree, one) for one in (a, b)]
        tree.add_edge(a, b, count=count)
        smaller, larger = sorted(sides, key=lambda side: (len(side), min(side)))
        if len(smaller) >= _FEWEST:
            found.append(
                Thread(
                    part=tuple(sorted(smaller)),
                    rest=len(larger),
                    link=(a, b) if a in smaller else (b, a),
                    matches=count,
                    usual=usual,
                    contradicted=tuple(_against(smaller, larger, matches, agreeing)),
                )
            )
    return tuple(found)


def _joined(names: list[str], matches: Matches, agreeing: Mapping[Pair, float]) -> nx.Graph:
    """The images, joined by their matches that agree; what contradicts the map holds nothing together."""
    graph = nx.Graph()
    graph.add_nodes_from(names)
    for (a, b), share in sorted(agreeing.items()):
        if a in graph and b in graph:
            graph.add_edge(a, b, count=round(share * len(matches[a, b])) if share >= MIN_AGREEING else 0)
    return graph


def _against(
    part: Collection[str], rest: Collection[str], matches: Matches, agreeing: Mapping[Pair, float]
) -> Iterator[Pair]:
    """Pairs of an image of a part and one of the rest whose matches contradict the map."""
    for (a, b), share in sorted(agreeing.items()):
        is_across = (a in part and b in rest) or (b in part and a in rest)
        if is_across and share < MIN_AGREEING and len(matches[a, b]) >= _STRONG:
            yield a, b
