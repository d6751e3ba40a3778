from dataclasses import replace

import numpy as np
import pytest

from scenes import algorithm_1, exact_map
from slimsfm.domination import dominates
from slimsfm.evaluation.variants import VARIANTS, VariantInputs, parse_variant
from slimsfm.reduction import DominatingSetOptions, dominating_set, keep_random_images


@pytest.fixture(scope="module")
def narrow():
    """Ten images; no image sees all points."""
    return exact_map(num_images=10, num_points=400, reach_deg=65.0)


@pytest.fixture(scope="module")
def making(narrow):
    graph, reduction = algorithm_1(narrow), DominatingSetOptions()
    return VariantInputs(
        map=narrow,
        graph=graph,
        reduction=reduction,
        solution=dominating_set(graph, reduction, narrow),
    )


def chosen(making, text):
    """Indices of the images in the only map of a variant."""
    (made,) = parse_variant(text).make(making)
    return [making.graph.names.index(name) for name in made.images]


GOOD = {
    "full": None,
    "default": None,
    "dominating": {},
    "dominating:k=2": {"dominators": 2},
    "dominating:rim": {"rim": True},
    "dominating:k=2,rim,budget=8": {"dominators": 2, "rim": True, "max_images": 8},
    "dominating:threshold=0.02,solver=random": {"threshold": 0.02, "solver": "random"},
    "dominating:cost=observations": {"cost": "observations"},
    "random": None,
    "random:8": 8,
    "points:500": (500, "information"),
    "points:500,kcover": (500, "kcover"),
}


@pytest.mark.parametrize("text", GOOD)
def test_a_variant_is_a_name_with_or_without_settings(text):
    variant = parse_variant(text)
    assert variant.name == text
    assert variant.kind == text.partition(":")[0]
    assert variant.settings == GOOD[text]
    assert variant.is_random == text.startswith("random")


@pytest.mark.parametrize("text", ["", "half", "FULL", ":8", "full2", "dominating k=2"])
def test_an_unknown_variant_is_an_error(text):
    with pytest.raises(ValueError, match=r"variants must be among full, .*, got '.*'"):
        parse_variant(text)


@pytest.mark.parametrize(
    "text",
    [
        *("full:", "full:3", "default:300"),
        *("dominating:", "dominating:2", "dominating:k", "dominating:k=", "dominating:k=two"),
        *("dominating:k=0", "dominating:size=3", "dominating:k=2,", "dominating:k=2,k=3"),
        *("dominating:rim=no", "dominating:budget=0", "dominating:threshold=-1", "dominating:threshold=x"),
        *("dominating:solver=guess", "dominating:cost=gold", "dominating:budget=3,cost=observations"),
        *("random:", "random:0", "random:-1", "random:x", "random:1.5", "random:3,4", "random:3=4"),
        *("points", "points:", "points:0", "points:x", "points:300,guess", "points:300=4"),
        "points:300,kcover,kcover",
    ],
)
def test_an_invalid_setting_of_a_variant_is_an_error(text):
    kind = text.partition(":")[0]
    with pytest.raises(ValueError, match=f"variants: {kind} takes ") as caught:
        parse_variant(text)
    assert VARIANTS[kind].takes in str(caught.value)
    assert f"got {text!r}" in str(caught.value)


def test_full_is_the_map_itself(making):
    (made,) = parse_variant("full").make(making)
    assert made is making.map


def test_the_dominating_variant_is_the_given_solution(making):
    found = chosen(making, "dominating")
    assert sorted(found) == sorted(making.solution.chosen)
    assert dominates(making.graph.adjacency(), found)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_a_set_that_dominates_k_times_localizes_each_other_image_from_k(making, k):
    """Or from all images that can, if there are fewer."""
    found, adjacency = chosen(making, f"dominating:k={k}"), making.graph.adjacency().toarray()
    np.fill_diagonal(adjacency, val=False)
    others = np.setdiff1d(np.arange(len(adjacency)), found)
    assert (adjacency[found][:, others].sum(axis=0) >= np.minimum(k, adjacency[:, others].sum(axis=0))).all()
    assert len(found) == len(
        dominating_set(making.graph, DominatingSetOptions(dominators=k), making.map).chosen
    )


def test_a_budget_is_respected(making):
    assert len(making.solution.chosen) > 1
    assert len(chosen(making, "dominating:budget=1")) == 1


def test_a_stricter_threshold_takes_more_images(making):
    """In an exact scene errors are only rounding, but still larger than this threshold."""
    assert len(chosen(making, "dominating:threshold=1e-12")) == 10


def test_settings_override_only_their_own_options(making):
    strict = replace(making, reduction=DominatingSetOptions(threshold=1e-12))
    assert len(chosen(strict, "dominating:k=2")) == 10
    assert len(chosen(strict, "dominating:threshold=0.05")) == len(making.solution.chosen)


def test_random_variants_are_five_draws_with_the_size_of_the_dominating_set(making):
    count = len(making.solution.chosen)
    draws = parse_variant("random").make(making)
    expected = [keep_random_images(making.map, count, seed=seed) for seed in range(5)]
    assert [list(one.images) for one in draws] == [list(one.images) for one in expected]
    assert len({tuple(one.images) for one in draws}) > 1


def test_random_variants_have_the_given_size(making):
    draws = parse_variant("random:3").make(making)
    assert [len(one.images) for one in draws] == [3] * 5


def test_a_random_variant_larger_than_the_map_is_left_out(making):
    assert len(parse_variant("random:10").make(making)) == 5
    assert parse_variant("random:11").make(making) == []


@pytest.mark.parametrize("text", ["points:300", "points:300,kcover"])
def test_the_points_variant_has_the_given_size(making, text):
    (made,) = parse_variant(text).make(making)
    assert len(made.point3D_ids) == 300
    assert made.is_for_direct_matching
    assert set(made.point3D_ids) <= set(making.map.point3D_ids)


def test_a_points_variant_larger_than_the_map_keeps_all_points(making):
    (made,) = parse_variant("points:100000").make(making)
    assert len(made.point3D_ids) == len(making.map.point3D_ids)


@pytest.mark.parametrize("text", ["default", "points:300"])
def test_a_map_without_keypoints_has_no_variant_for_direct_matching(making, text):
    keypoint_free = replace(making.map, info=replace(making.map.info, extractor="loftr"))
    assert parse_variant(text).make(replace(making, map=keypoint_free)) == []
