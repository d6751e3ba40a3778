"""What many ways to reduce a map keep and are predicted to lose."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import algorithm_1, exact_map
from slimsfm.domination import dominates
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.mapping.io import bytes_by_part, weigh_map, write_map
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction import (
    USES,
    FrontierOptions,
    ReductionLimits,
    apply_choice,
    forecast_images,
    frontier,
    points_seen,
)
from slimsfm.selection import SELECTORS

BUDGETS = (15, 40)
FEW = FrontierOptions(uses=USES, budgets=BUDGETS, dominators=(1, 2), rim=(False,))


@pytest.fixture(scope="module")
def narrow():
    """Ten images that see some of the points each, with slightly different descriptors."""
    map_, rng = exact_map(num_images=10, num_points=90, reach_deg=65), np.random.default_rng(0)
    features = {
        name: replace(
            one, descriptors=unit_rows(one.descriptors + rng.normal(0, 0.03, one.descriptors.shape))
        )
        for name, one in map_.features.items()
    }
    return replace(map_, features=features)


@pytest.fixture(scope="module")
def graph(narrow):
    return algorithm_1(narrow)


@pytest.fixture(scope="module")
def found(narrow, graph):
    return frontier(narrow, FEW, graph=graph)


def of(found, use, *methods):
    return [one for one in found.candidates if one.choice.use == use and one.choice.method in methods]


def test_each_selector_is_asked_for_each_budget(narrow, found):
    for selector in FEW.selectors:
        sets = [one.choice.points for one in of(found, "direct", selector)]
        assert [len(points) for points in sets] == list(BUDGETS)
        for points in sets:
            assert np.array_equal(points, np.unique(points))
            assert 0 <= points.min() <= points.max() < len(narrow.point3D_ids)


def test_images_are_dominating_sets_and_their_points_are_listed_for_both_uses(narrow, graph, found):
    by_images, by_points = of(found, "images", "dominating"), of(found, "direct", "dominating")
    assert 1 <= len(by_images) == len(by_points) <= 2
    for images, points in zip(by_images, by_points, strict=True):
        names = images.choice.images
        assert dominates(graph.adjacency(), [graph.names.index(name) for name in names])
        assert np.array_equal(
            narrow.point3D_ids[images.choice.points], keep_images(narrow, names).point3D_ids
        )
        assert np.array_equal(images.choice.points, points.choice.points)
        assert points.choice.images == ()
        assert set(images.prediction.tests) == set(narrow.images) - set(names)


def test_bytes_are_those_of_the_map_that_is_made(narrow, found, tmp_path):
    for number, one in enumerate(found.candidates):
        made = apply_choice(narrow, one.choice)
        check_map(made)
        write_map(made, tmp_path / str(number))
        assert one.bytes == bytes_by_part(tmp_path / str(number))["total"]
        assert np.array_equal(made.point3D_ids, narrow.point3D_ids[one.choice.points])
        assert made.is_for_direct_matching == (one.choice.use == "direct")
        if one.choice.use == "images":
            assert tuple(made.images) == one.choice.images


def test_each_candidate_stands_against_the_full_map_on_the_same_tests(narrow, found):
    assert set(found.full.tests) == set(narrow.images)
    for one in found.candidates:
        assert one.full.tests == one.prediction.tests
        rows = [found.full.tests.index(name) for name in one.full.tests]
        assert np.array_equal(one.full.errors, found.full.errors[rows])


def test_more_points_weigh_more_and_have_more_inliers(found):
    for selector in FEW.selectors:
        few, many = of(found, "direct", selector)
        assert few.bytes < many.bytes
        assert few.prediction.inliers.mean() < many.prediction.inliers.mean()


def test_equal_maps_have_equal_frontiers(narrow, graph, found):
    again = frontier(narrow, FEW, graph=graph)
    assert np.array_equal(again.full.errors, found.full.errors)
    assert len(again.candidates) == len(found.candidates)
    for a, b in zip(again.candidates, found.candidates, strict=True):
        for part in ("use", "method", "detail", "images"):
            assert getattr(a.choice, part) == getattr(b.choice, part)
        assert np.array_equal(a.choice.points, b.choice.points)
        assert (a.bytes, a.losses, a.prediction.tests) == (b.bytes, b.losses, b.prediction.tests)
        assert np.array_equal(a.prediction.errors, b.prediction.errors)
        assert np.array_equal(a.prediction.inliers, b.prediction.inliers)


@pytest.mark.parametrize("uses", [("direct",), ("images",)])
def test_only_what_it_is_for_is_tried(narrow, graph, found, uses):
    some = frontier(narrow, replace(FEW, uses=uses, budgets=(15,), dominators=(1,)), graph=graph)
    assert {one.choice.use for one in some.candidates} == set(uses)
    assert np.array_equal(some.full.errors, found.full.errors)


def test_points_need_no_graph(narrow):
    options = replace(FEW, uses=("direct",), budgets=(15,), selectors=tuple(SELECTORS))
    some = frontier(narrow, options, graph=forbidden)
    assert [one.choice.method for one in some.candidates] == list(SELECTORS)


def forbidden(_map, _options):
    raise AssertionError("the graph is not needed")


@pytest.mark.parametrize("given", [None, lambda map_, options: compute_graph(map_, options).graph])
def test_images_need_a_graph_which_is_computed_or_requested(narrow, given):
    options = replace(FEW, uses=("images",), edges="localize")
    some = frontier(narrow, options, graph=given)
    expected = frontier(narrow, options, graph=compute_graph(narrow, GraphOptions(edges="localize")).graph)
    assert [one.choice.images for one in some.candidates] == [
        one.choice.images for one in expected.candidates
    ]


def test_limits_that_no_choice_meets_are_refused_before_anything_is_predicted(narrow):
    labels = []

    def watch(items, label):
        labels.append(label)
        return iter(items)

    options = replace(FEW, uses=("direct",), selectors=("kcover",))
    with pytest.raises(
        InputError, match=r"no choice for direct meets max_bytes 10; the nearest, kcover \(15 po"
    ):
        frontier(narrow, options, limits=ReductionLimits(max_bytes=10.0), progress=watch)
    assert "predict losses" not in labels


def test_budgets_beyond_all_usable_points_are_tried_once(narrow):
    options = FrontierOptions(uses=("direct",), budgets=(2000, 50, 1000, 50), selectors=("kcover",))
    sizes = [len(one.choice.points) for one in frontier(narrow, options).candidates]
    assert sizes[0] == 50
    assert len(sizes) == 2
    assert 50 < sizes[1] <= len(narrow.point3D_ids)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uses": ()}, "uses must be among direct, images, got none"),
        ({"uses": ("fun",)}, "uses must be among direct, images, got fun"),
        ({"selectors": ("kcover", "oracle")}, r"selectors must be among .*, got kcover, oracle"),
        ({"budgets": ()}, r"budgets must be positive, got \(\)"),
        ({"budgets": (100, 0)}, "budgets must be positive"),
        ({"dominators": (0,)}, "dominators must be positive"),
        ({"seed": -1}, "seed must not be negative, got -1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        FrontierOptions(**options)


def test_images_that_are_named_are_tried(narrow):
    names = ["004.png", "001.png", "004.png"]
    one = forecast_images(narrow, names)
    assert one.choice.images == ("001.png", "004.png")
    assert np.array_equal(one.choice.points, points_seen(narrow, one.choice.images))
    assert one.bytes == weigh_map(keep_images(narrow, names))
    assert set(one.prediction.tests) == set(narrow.images) - set(names)
    assert one.full.tests == one.prediction.tests
    with pytest.raises(InputError, match="'missing"):
        forecast_images(narrow, ["missing.png"])


def test_where_all_images_are_kept_there_are_no_tests(narrow):
    one = forecast_images(narrow, list(narrow.images))
    assert one.prediction.tests == one.full.tests == ()
    assert one.loss == 0.0
