"""What every source of edges keeps to, and what each is for."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from scenes import exact_map, with_matches
from slimsfm.errors import InputError
from slimsfm.graph import EDGE_SOURCES, EdgeSource, GraphOptions, compute_graph
from slimsfm.graph.edge_sources import HybridEdges, LocalizeEdges, MatchEdges, edge_source, resolve_edges
from slimsfm.mapping.subset import keep_images

EXACT = 1e-4
OPTIONS = GraphOptions()


def matched_all_to_all(map_):
    """The map with the matches that its tracks imply, of every two images; the later one named first."""
    matches = {}
    for a, b in combinations(map_.images, 2):
        of_a, of_b = map_.observations[a], map_.observations[b]
        _, rows_a, rows_b = np.intersect1d(of_a.points, of_b.points, return_indices=True)
        matches[b, a] = np.stack([of_b.rows[rows_b], of_a.rows[rows_a]], axis=1)
    return replace(map_, matches=matches)


def as_tuple(errors):
    return errors.v_from_u, errors.u_from_v


class CountedMatches(dict):
    """Matches that count how often each is read."""

    def __init__(self, matches):
        super().__init__(matches)
        self.reads = Counter()

    def __getitem__(self, pair):
        self.reads[pair] += 1
        return super().__getitem__(pair)


@pytest.fixture(scope="module")
def maps(exact, boulder):
    narrow = with_matches(exact_map(num_images=8, reach_deg=80.0))
    some = keep_images(boulder.map, list(boulder.map.images)[::4])
    return {"exact": exact, "narrow": narrow, "rendered": some}


@pytest.mark.parametrize("scene", ["exact", "narrow", "rendered"])
@pytest.mark.parametrize("edges", sorted(EDGE_SOURCES))
def test_the_contract_of_a_source(maps, scene, edges):
    map_, options = maps[scene], GraphOptions(edges=edges)
    source = edge_source(map_, options)
    assert isinstance(source, EdgeSource)
    pairs = source.pairs()
    assert pairs.dtype == np.int64
    assert np.all(pairs[:, 0] < pairs[:, 1])
    assert pairs.min() >= 0
    assert pairs.max() < len(map_.images)
    listed = pairs.tolist()
    assert listed == sorted(listed)
    assert len({tuple(pair) for pair in listed}) == len(listed) > 0
    errors = [as_tuple(one) for one in source.errors(pairs)]
    assert np.min(errors) >= 0
    again = edge_source(map_, options)
    assert np.array_equal(again.pairs(), pairs)
    backwards = [
        as_tuple(one) for row in range(len(pairs))[::-1] for one in again.errors(pairs[row : row + 1])
    ]
    assert backwards[::-1] == errors
    assert [as_tuple(one) for one in source.errors(pairs[:, ::-1])] == [pair[::-1] for pair in errors]
    assert source.errors(pairs[:0]) == []
    graph = compute_graph(map_, options).graph.dense()
    assert [(graph[u, v], graph[v, u]) for u, v in listed] == errors
    others = ~np.eye(len(graph), dtype=bool)
    others[tuple(pairs.T)] = others[tuple(pairs[:, ::-1].T)] = False
    assert np.all(np.isinf(graph[others]))


@pytest.mark.parametrize("edges", sorted(EDGE_SOURCES))
def test_where_all_is_seen_every_source_finds_every_edge_without_error(exact, edges):
    graph = compute_graph(matched_all_to_all(exact), GraphOptions(edges=edges)).graph
    assert graph.num_edges() == 6 * 5
    assert graph.dense().max() < EXACT


def test_every_match_is_read_once(exact):
    matches = CountedMatches(matched_all_to_all(exact).matches)
    map_ = replace(exact, matches=matches)
    matches.reads.clear()  # what checked the types has read some
    compute_graph(map_, GraphOptions(edges="matches"))
    assert matches.reads == dict.fromkeys(matches, 1)


def test_images_without_matches_have_no_edge(exact):
    assert len(exact.matches) == 5
    graph = compute_graph(exact, GraphOptions(edges="matches")).graph
    chain = np.eye(6, k=1, dtype=bool) | np.eye(6, k=-1, dtype=bool)
    assert np.array_equal(graph.adjacency().toarray(), chain)


def test_matches_with_images_that_have_no_pose_are_passed_over(exact):
    stray = {("001.png", "stray.png"): np.array([[0, 0]]), ("a.png", "b.png"): np.array([[0, 0]])}
    found = MatchEdges(replace(exact, matches={**exact.matches, **stray}), OPTIONS).pairs()
    assert np.array_equal(found, MatchEdges(exact, OPTIONS).pairs())


def test_a_matched_keypoint_localizes_only_where_it_sees_a_point():
    """u and v match, but only u sees points: v is localized from u, not u from v."""
    map_ = matched_all_to_all(exact_map(num_images=3))
    blind = map_.images["002.png"].image_id
    for row in map_.model.image(blind).get_observation_point2D_idxs():
        map_.model.delete_observation(blind, row)
    map_ = replace(map_, model=map_.model)
    found = MatchEdges(map_, OPTIONS).errors(np.array([[0, 1]]))[0]
    assert found.v_from_u < EXACT
    assert np.isinf(found.u_from_v)


def test_tracks_need_no_matches_and_no_features():
    map_ = exact_map(num_images=8, reach_deg=80.0)
    seen = [set(one.points.tolist()) for one in map_.observations.values()]
    expected = np.array([[a is not b and len(a & b) >= 12 for b in seen] for a in seen])
    graph = compute_graph(replace(map_, features={}), GraphOptions(edges="tracks")).graph
    assert np.array_equal(graph.adjacency().toarray(), expected)
    assert graph.errors.data.max() < EXACT
    assert 0 < expected.sum() < 56


def test_auto_is_matches_or_tracks_where_there_are_none(exact):
    assert resolve_edges(exact, OPTIONS) == "matches"
    assert isinstance(edge_source(exact, OPTIONS), MatchEdges)
    bare = replace(exact, matches={})
    assert resolve_edges(bare, OPTIONS) == "tracks"
    assert [resolve_edges(exact, GraphOptions(edges=edges)) for edges in EDGE_SOURCES] == list(EDGE_SOURCES)
    with pytest.raises(InputError, match="no matches; use `edges='tracks'` or `edges='localize'`"):
        edge_source(bare, GraphOptions(edges="matches"))


@pytest.fixture
def localized(monkeypatch):
    """The edges (reference, query) that are decided by matching again."""
    edges = []
    localize = LocalizeEdges.errors_of

    def counted(self, directed):
        edges.extend(directed)
        return localize(self, directed)

    monkeypatch.setattr(LocalizeEdges, "errors_of", counted)
    return edges


def test_hybrid_leaves_alone_what_matches_decide(exact, localized):
    map_ = matched_all_to_all(exact)
    hybrid = compute_graph(map_, GraphOptions(edges="hybrid")).graph
    assert localized == []
    assert np.array_equal(hybrid.dense(), compute_graph(map_, GraphOptions(edges="matches")).graph.dense())


def test_hybrid_localizes_what_sees_common_points_but_has_no_matches(exact, localized):
    hybrid = compute_graph(exact, GraphOptions(edges="hybrid")).graph
    assert sorted(localized) == [(u, v) for u in range(6) for v in range(6) if abs(u - v) > 1]
    assert hybrid.num_edges() == 30


def test_hybrid_looks_closer_at_missing_poses_and_at_errors_near_the_threshold(boulder, localized):
    map_, options = boulder.map, GraphOptions(edges="hybrid", threshold=0.02)
    hybrid, matched, again = (make(map_, options) for make in (HybridEdges, MatchEdges, LocalizeEdges))
    matched_pairs = {tuple(pair) for pair in matched.pairs().tolist()}
    decided = 0
    for u, v in hybrid.pairs()[::3].tolist():
        pair = np.array([[u, v]])
        found = as_tuple(hybrid.errors(pair)[0])
        asked = localized.copy()
        by_matches = as_tuple(matched.errors(pair)[0]) if (u, v) in matched_pairs else (np.inf, np.inf)
        by_localizing = as_tuple(again.errors(pair)[0])
        is_open = [error == np.inf or 0.01 <= error <= 0.04 for error in by_matches]
        assert asked == [edge for edge, open_ in zip([(u, v), (v, u)], is_open, strict=True) if open_]
        assert found == tuple(np.where(is_open, by_localizing, by_matches))
        decided += 2 - sum(is_open)
        localized.clear()
    assert decided > 0


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_is_positive(threshold):
    with pytest.raises(ValueError, match="threshold must be positive"):
        GraphOptions(threshold=threshold)
