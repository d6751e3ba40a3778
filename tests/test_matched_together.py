"""Whoever matches pairs of images gives those that are known together to the matcher in one call."""

import numpy as np
import pytest

from scenes import algorithm_1, camera, exact_map
from slimsfm.features import MATCHERS, BatchMatcher, Features, Matcher, match_many
from slimsfm.features.nearest import Nearest
from slimsfm.features.store import FeatureWriter
from slimsfm.graph import GraphOptions, GraphWork, compute_graph
from slimsfm.localization.options import load_strategy
from slimsfm.localization.strategy import MatchingOptions, Query
from slimsfm.mapping.matching import PairMatching, match_and_verify
from slimsfm.mapping.pairs import exhaustive_pairs
from slimsfm.mapping.workspace import FEATURES, Workspace

PATIENT = GraphWork(block_seconds=1000.0)
CALLS: list[int] = []  # how many pairs came in each call


class Counted(Nearest):
    """Nearest neighbors of all pairs of a call."""

    def match_many(self, pairs):
        CALLS.append(len(pairs))
        return [self.match(*pair) for pair in pairs]


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    monkeypatch.setitem(MATCHERS, "counted", "test_matched_together:Counted")
    CALLS.clear()


@pytest.fixture(scope="module")
def ring():
    return exact_map(num_images=12, reach_deg=80.0)


def query_of(features: Features) -> Query:
    return Query(
        keypoints=features.keypoints.astype(np.float64),
        descriptors=features.descriptors,
        features=features,
        camera=camera(),
    )


def rounds_of(strategy: str, ring, matcher: str) -> list:
    made = load_strategy(strategy, ring, MatchingOptions(matcher=matcher, retrieved=3))
    return list(made.rounds(query_of(next(iter(ring.features.values())))))


@pytest.mark.parametrize(
    ("strategy", "calls"),
    [("exhaustive", [12]), ("retrieval", [3]), ("progressive", [1, 1, 1, 2, 3, 12])],
)
def test_a_round_is_one_call(ring, strategy, calls):
    by_call = rounds_of(strategy, ring, "counted")
    assert calls == CALLS
    one_by_one = rounds_of(strategy, ring, "nearest")
    assert len(by_call) == len(one_by_one)
    for found, expected in zip(by_call, one_by_one, strict=True):
        assert np.array_equal(found.keypoints, expected.keypoints)
        assert np.array_equal(found.points, expected.points)
        assert found.references == expected.references


def test_the_pairs_of_a_block_of_the_graph_come_in_calls_of_at_most_64(ring):
    graph = compute_graph(
        ring, GraphOptions(edges="localize", candidates="all", matcher="counted"), PATIENT
    ).graph
    assert CALLS[:2] == [16, 64]  # first those that tell how long it takes
    assert max(CALLS) == 64
    assert sum(CALLS) == 12 * 11
    assert np.array_equal(graph.dense(), algorithm_1(ring).dense())


def test_a_block_of_a_build_is_one_call(ring, tmp_path):
    names = list(ring.features)[:6]
    workspace = Workspace(tmp_path, {})
    with FeatureWriter(tmp_path / FEATURES) as writer:
        for name in names:
            writer.write(name, ring.features[name])
    matching = PairMatching(
        features=tmp_path / FEATURES,
        turns={},
        factors=dict.fromkeys(names, 1.0),
        cameras=dict.fromkeys(names, camera()),
        matcher=Counted(),
        one_thread=False,
        seed=0,
    )
    assert match_and_verify(matching, exhaustive_pairs(names), workspace)
    assert CALLS == [10, 5]


def test_a_matcher_of_one_pair_matches_one_after_the_other(ring):
    one, other, *_ = ring.features.values()
    assert isinstance(Nearest(), Matcher)
    assert not isinstance(Nearest(), BatchMatcher)
    assert isinstance(Counted(), BatchMatcher)
    found = match_many(Nearest(), [(one, other), (other, one)])
    assert np.array_equal(found[0], Nearest().match(one, other))
    assert np.array_equal(found[1], Nearest().match(other, one))
