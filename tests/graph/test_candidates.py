"""Pairs worth trying, and what leaving out the others costs."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.features import Features
from slimsfm.graph import GraphOptions, GraphRun, ReferenceGraph, compute_graph
from slimsfm.graph.compute import estimate_recall
from slimsfm.graph.edge_sources import all_pairs, covisible_pairs, likely_pairs

LIKELY = GraphOptions(edges="localize", candidates="likely")
ALL = replace(LIKELY, candidates="all")
MATCHED = GraphOptions(edges="matches")


def as_set(pairs):
    assert pairs.dtype == np.int64
    assert pairs.tolist() == sorted(pairs.tolist())
    found = {tuple(pair) for pair in pairs.tolist()}
    assert len(found) == len(pairs)
    assert all(u < v for u, v in found)
    return found


def common_points(map_):
    seen = [set(one.points.tolist()) for one in map_.observations.values()]
    return {(u, v): len(seen[u] & seen[v]) for u, v in combinations(range(len(seen)), 2)}


@pytest.mark.parametrize("reach_deg", [20.0, 50.0, 80.0, 180.0])
@pytest.mark.parametrize("min_points", [1, 5, 12, 40])
def test_covisible_pairs_are_those_of_a_search_by_hand(reach_deg, min_points):
    map_ = exact_map(num_images=9, reach_deg=reach_deg)
    expected = {pair for pair, count in common_points(map_).items() if count >= min_points}
    assert as_set(covisible_pairs(map_, min_points)) == expected


def test_covisible_pairs_of_a_rendered_object(boulder):
    map_ = boulder.map
    expected = {pair for pair, count in common_points(map_).items() if count >= 15}
    assert as_set(covisible_pairs(map_, 15)) == expected
    assert 0 < len(expected) < len(all_pairs(map_))


@pytest.mark.parametrize("num_images", [2, 7])
def test_all_pairs_are_all(num_images):
    map_ = exact_map(num_images=num_images)
    assert as_set(all_pairs(map_)) == set(combinations(range(num_images), 2))


@pytest.mark.parametrize("reach_deg", [30.0, 80.0, 180.0])
def test_likely_pairs_hold_all_that_see_a_common_point(reach_deg):
    map_ = exact_map(num_images=12, reach_deg=reach_deg)
    assert as_set(covisible_pairs(map_)) <= as_set(likely_pairs(map_)) <= as_set(all_pairs(map_))


def test_cameras_that_look_at_the_box_from_opposite_sides_are_not_tried():
    map_ = exact_map(num_images=12, reach_deg=30.0)
    eyes = np.array([image.projection_center() for image in map_.images.values()])
    directions = -eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    likely, covisible = as_set(likely_pairs(map_)), as_set(covisible_pairs(map_))
    for u, v in combinations(range(12), 2):
        if angles[u, v] > 90 and (u, v) not in covisible:
            assert (u, v) not in likely
        if angles[u, v] < 60:
            assert (u, v) in likely
    assert len(likely) < 12 * 11 / 2


def test_nothing_is_missed_where_all_pairs_were_tried(exact):
    run = compute_graph(exact, ALL)
    assert estimate_recall(exact, run, ALL) == 1.0
    assert estimate_recall(exact, compute_graph(exact, LIKELY), LIKELY) == 1.0


def partly_tried(map_, count):
    """A map of which only the first pairs have matches, and its graph by localizing just these pairs."""
    names, pairs = tuple(map_.images), all_pairs(map_)[:count]
    map_ = replace(map_, matches={(names[u], names[v]): np.zeros((0, 2), np.int64) for u, v in pairs})
    both_ways = np.concatenate([pairs, pairs[:, ::-1]])
    errors = compute_graph(map_, ALL).graph.dense()[both_ways[:, 0], both_ways[:, 1]]
    graph = ReferenceGraph.from_errors(names, both_ways, errors)
    return map_, GraphRun(graph=graph, pairs_tried=count, seconds={})


def test_the_estimated_share_of_edges_on_the_pairs_tried_is_near_the_true_one():
    """Every image localizes every other image, but only some pairs are tried: the true share is known."""
    map_, tried = exact_map(num_images=24), 24 * 23 // 2 - 60
    map_, run = partly_tried(map_, tried)
    truth = run.graph.num_edges() / compute_graph(map_, ALL).graph.num_edges()
    assert truth == pytest.approx(tried / 276)
    assert estimate_recall(map_, run, MATCHED) == pytest.approx(truth)


@pytest.mark.parametrize("seed", range(3))
def test_a_sample_of_the_skipped_pairs_represents_all_of_them(seed):
    """Half of the images have descriptors of their own, so that they localize only each other."""
    map_ = exact_map(num_images=24)
    features = {
        name: one
        if number % 2
        else Features(
            keypoints=one.keypoints,
            descriptors=np.ascontiguousarray(np.roll(one.descriptors, 7, axis=1)),
            scores=one.scores,
            image_size=one.image_size,
        )
        for number, (name, one) in enumerate(map_.features.items())
    }
    map_ = replace(map_, features=features)
    map_, run = partly_tried(map_, 60)
    truth = run.graph.num_edges() / compute_graph(map_, ALL).graph.num_edges()
    assert 0.1 < truth < 0.9
    assert estimate_recall(map_, run, MATCHED, sample=100, seed=seed) == pytest.approx(truth, rel=0.25)
