"""One call reduces a map; options that contradict each other are refused, and both are named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes import algorithm_1, exact_map, with_shuffled_points
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.io import weigh_map
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images, with_points
from slimsfm.reduction import (
    FrontierOptions,
    ImageOptions,
    ReduceOptions,
    ReductionLimits,
    apply_choice,
    frontier,
    recommend,
    reduce,
)

# One value of each option that chooses images.
IMAGE_CHOICES = {
    "images": ("001.png",),
    "random": 2,
    "solver": "greedy",
    "dominators": 2,
    "rim": True,
    "cost": "observations",
    "threshold": 0.1,
    "edges": "tracks",
    "graph": Path("errors.csv"),
    "paper": True,
}
LIMITS = {
    "max_loss": 1.0,
    "max_median_factor": 2.0,
    "max_p90_factor": 3.0,
    "max_error": 0.1,
    "max_relative_error": 0.05,
    "max_bytes": 1e5,
    "max_ms": 5.0,
    "max_points": 100,
    "max_images": 3,
}


@pytest.fixture(scope="module")
def narrow():
    """Eight images that see some of the points each, with slightly different descriptors."""
    map_, rng = exact_map(num_images=8, num_points=120, reach_deg=70), np.random.default_rng(0)
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


def choosing(name):
    return ImageOptions(**{name: IMAGE_CHOICES[name]})


def limited(name):
    return ReductionLimits(**{name: LIMITS[name]})


def test_without_options_points_are_kept_as_recommended(narrow):
    reduced = reduce(narrow)
    best = recommend(frontier(narrow, FrontierOptions(uses=("direct",))), "direct")
    assert list(reduced.forecast) == ["direct"]
    one = reduced.forecast["direct"]
    assert np.array_equal(one.choice.points, best.choice.points)
    assert (one.bytes, one.losses) == (best.bytes, best.losses)
    assert one.bytes == weigh_map(reduced.map)
    assert reduced.map.is_for_direct_matching
    assert np.array_equal(reduced.map.point3D_ids, apply_choice(narrow, best.choice).point3D_ids)
    check_map(reduced.map)


def test_for_both_uses_there_are_two_forecasts_and_one_map(narrow, graph):
    options = ReduceOptions(for_="both", selector="kcover", image_choice=ImageOptions(solver="exact"))
    reduced = reduce(narrow, options, graph=graph)
    assert sorted(reduced.forecast) == ["direct", "images"]
    images, points = reduced.forecast["images"].choice.images, reduced.forecast["direct"].choice.points
    assert reduced.solution is not None
    assert [graph.names[i] for i in reduced.solution.chosen] == list(images) == list(reduced.map.images)
    expected = with_points(keep_images(narrow, images), narrow, describe_points(narrow)[points])
    assert np.array_equal(reduced.map.point3D_ids, expected.point3D_ids)


@pytest.mark.parametrize(
    ("wanted", "method", "detail"),
    [
        (ImageOptions(images=("001.png", "004.png")), "images", "001.png, 004.png"),
        (ImageOptions(random=3), "random", "3 images, seed 0"),
        (ImageOptions(dominators=2, rim=True), "dominating", "exact, k = 2 and rim"),
        (ImageOptions(paper=True), "dominating", "the paper's Algorithms 1 and 2"),
    ],
)
def test_the_forecast_names_how_images_were_chosen(narrow, graph, wanted, method, detail):
    choice = reduce(narrow, ReduceOptions(image_choice=wanted), graph=graph).forecast["images"].choice
    assert choice.method == method
    assert choice.detail.startswith(detail)


def test_a_note_says_that_a_selector_was_replaced(narrow):
    reduced = reduce(narrow, ReduceOptions(selector="probabilistic"))
    assert reduced.notes == ("selector probabilistic has been removed; kcover is used instead",)
    assert reduced.forecast["direct"].choice.method == "kcover"


@pytest.mark.parametrize("name", IMAGE_CHOICES)
def test_an_option_about_images_chooses_images_and_contradicts_for_direct(name):
    assert ReduceOptions(image_choice=choosing(name)).uses == ("images",)
    assert ReduceOptions(image_choice=choosing(name), for_="both").uses == ("direct", "images")
    with pytest.raises(InputError, match=f"{name} chooses images, but for direct keeps only points"):
        ReduceOptions(image_choice=choosing(name), for_="direct")


@pytest.mark.parametrize("name", IMAGE_CHOICES)
def test_a_selector_contradicts_options_that_keep_only_images(name):
    with pytest.raises(InputError, match=f"selector chooses points, but {name} keeps only images"):
        ReduceOptions(selector="random", image_choice=choosing(name))
    with pytest.raises(InputError, match="selector chooses points, but for images keeps only images"):
        ReduceOptions(selector="random", for_="images")
    assert ReduceOptions(selector="random", image_choice=choosing(name), for_="both").selector == "random"


@pytest.mark.parametrize("exclusive", ["images", "random", "paper"])
@pytest.mark.parametrize("other", IMAGE_CHOICES)
def test_images_random_and_paper_exclude_all_other_ways_to_choose_images(exclusive, other):
    if exclusive == other:
        return
    with pytest.raises(InputError, match="excludes all other ways to choose images, but") as refusal:
        ImageOptions(**{name: IMAGE_CHOICES[name] for name in (exclusive, other)})
    assert exclusive in str(refusal.value)
    assert other in str(refusal.value)


def test_a_graph_that_is_given_contradicts_how_to_compute_one():
    with pytest.raises(InputError, match="graph gives the reference graph, so edges"):
        ImageOptions(graph=Path("errors.csv"), edges="tracks")


@pytest.mark.parametrize("name", IMAGE_CHOICES)
@pytest.mark.parametrize(
    "limit",
    ["max_loss", "max_median_factor", "max_p90_factor", "max_error", "max_relative_error", "max_ms"],
)
def test_limits_that_compare_choices_contradict_a_single_one(name, limit):
    with pytest.raises(InputError, match=f"{limit}|{name}") as refusal:
        ReduceOptions(image_choice=choosing(name), limits=limited(limit))
    assert limit in str(refusal.value)
    assert name in str(refusal.value)


@pytest.mark.parametrize("name", ["images", "random"])
@pytest.mark.parametrize("limit", LIMITS)
def test_given_images_leave_nothing_to_limit(name, limit):
    with pytest.raises(InputError, match=f"{name} leaves nothing to choose, so {limit} cannot limit it"):
        ReduceOptions(image_choice=choosing(name), limits=limited(limit))
    if limit != "max_images":
        ReduceOptions(image_choice=choosing(name), limits=limited(limit), for_="both")


def test_a_number_of_images_contradicts_points():
    for use in ("direct", None):
        with pytest.raises(InputError, match="max_images limits images, but"):
            ReduceOptions(for_=use, limits=limited("max_images"))
    with pytest.raises(InputError, match=r"max_images .* cost must be image"):
        ReduceOptions(image_choice=choosing("cost"), limits=limited("max_images"))


@pytest.mark.parametrize(
    "options", [ReduceOptions(for_="direct"), ReduceOptions(for_="both"), ReduceOptions(selector="kcover")]
)
def test_a_map_without_a_detector_has_no_points_to_keep(narrow, options):
    info = replace(narrow.info, extractor="loftr", extractor_options={})
    with pytest.raises(InputError, match="keeps points to match, but the map was built without a detector"):
        reduce(replace(narrow, info=info), options)


def test_a_map_of_one_image_is_refused(narrow):
    with pytest.raises(InputError, match="one image; there is nothing to reduce"):
        reduce(keep_images(narrow, ["001.png"]))


def test_limits_beyond_any_set_of_images_name_the_nearest(narrow, graph):
    options = ReduceOptions(image_choice=ImageOptions(solver="exact"), limits=ReductionLimits(max_points=1))
    with pytest.raises(InputError, match=r"no set of images meets max_points 1; the nearest, 00\d.png alone"):
        reduce(narrow, options, graph=graph)


@pytest.mark.parametrize("choice", [{}, {"image_choice": ImageOptions(images=("001.png",))}])
def test_what_localizes_nothing_is_not_given_out(choice):
    with pytest.raises(InputError, match=r"would localize none of (3|4) images left out; nor"):
        reduce(with_shuffled_points(exact_map(num_images=4)), ReduceOptions(**choice))
