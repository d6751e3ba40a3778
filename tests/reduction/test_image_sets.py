from dataclasses import replace
from importlib.util import find_spec

import networkx as nx
import numpy as np
import pytest

from scenes import algorithm_1, exact_map, graph_from_dense
from slimsfm.domination import SOLVERS, DominationProblem, dominates
from slimsfm.errors import InputError
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction import ImageOptions, ReduceOptions, reduce
from slimsfm.reduction.image_sets import (
    DominatingSetOptions,
    dominating_set,
    image_order,
    images_within,
    keep_random_images,
    rim_groups,
)

ERRORS = [0.001, 0.02, 0.049, 0.05, 0.08, 0.3, np.inf]


def random_graph(names, seed):
    errors = np.random.default_rng(seed).choice(ERRORS, (len(names), len(names)))
    np.fill_diagonal(errors, 0.0)
    return graph_from_dense(tuple(names), errors)


@pytest.fixture(scope="module")
def narrow():
    return exact_map(num_images=10, reach_deg=65.0)


@pytest.fixture(scope="module")
def narrow_graph(narrow):
    return algorithm_1(narrow)


needs_ortools = pytest.mark.skipif(
    find_spec("ortools") is None, reason="needs OR-Tools, which is not installed"
)
every_solver = pytest.mark.parametrize(
    "solver", [pytest.param(name, marks=needs_ortools if name == "cpsat" else ()) for name in SOLVERS]
)


def options_of(*, seed=0, **options):
    return ReduceOptions(image_choice=ImageOptions(**options), seed=seed)


def chosen_by(graph, map_=None, **options):
    return dominating_set(graph, DominatingSetOptions(**options), map_).chosen


def reduced_by(map_, graph, **options):
    """The map of a dominating set, as `reduce` makes it."""
    chosen = dominating_set(graph, DominatingSetOptions(**options), map_).chosen
    return keep_images(map_, (graph.names[i] for i in chosen))


def total_error(graph, chosen):
    return DominationProblem(graph.adjacency(), errors=graph.errors).total_error(chosen)


@every_solver
def test_kept_images_are_those_of_the_solver_and_localize_all_others(narrow, narrow_graph, solver):
    chosen = chosen_by(narrow_graph, narrow, solver=solver, seed=3)
    assert len(chosen) == len(SOLVERS[solver](DominationProblem(narrow_graph.adjacency()), seed=3).chosen)
    kept = reduce(narrow, options_of(solver=solver, seed=3), graph=narrow_graph).map
    assert list(kept.images) == [narrow_graph.names[i] for i in chosen]
    assert dominates(narrow_graph.adjacency(), chosen)
    as_networkx = nx.from_scipy_sparse_array(narrow_graph.adjacency(), create_using=nx.DiGraph)
    assert nx.is_dominating_set(as_networkx, chosen)
    assert 1 <= len(chosen) < 10


def test_kept_points_are_those_that_kept_images_see(narrow, narrow_graph):
    slim = reduce(narrow, options_of(solver="exact"), graph=narrow_graph).map
    check_map(slim)
    seen = {i for name in slim.images for i in narrow.point3D_ids[narrow.observations[name].points].tolist()}
    assert set(slim.point3D_ids.tolist()) == seen
    assert len(seen) < len(narrow.point3D_ids)
    for name, image in slim.images.items():
        assert np.array_equal(image.cam_from_world().matrix(), narrow.images[name].cam_from_world().matrix())


@every_solver
@pytest.mark.parametrize("seed", range(10))
def test_every_image_keeps_a_kept_one_that_localizes_it(exact, solver, seed):
    graph = random_graph(exact.images, seed)
    for threshold in (0.03, 0.05, 0.1):
        slim = reduced_by(exact, graph, threshold=threshold, solver=solver)
        kept = [graph.names.index(name) for name in slim.images]
        errors = graph.dense()
        for v in range(len(graph.names)):
            assert v in kept or any(errors[u, v] < threshold for u in kept)


@pytest.mark.parametrize("seed", range(10))
def test_a_larger_threshold_never_needs_more_images(exact, seed):
    graph = random_graph(exact.images, seed)
    sizes = [
        len(chosen_by(graph, exact, threshold=threshold)) for threshold in (0.001, 0.03, 0.05, 0.06, 0.5, 1.0)
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] == len(exact.images)


def test_the_exact_solver_is_never_beaten(narrow, narrow_graph):
    exact, drawn = (
        dominating_set(narrow_graph, DominatingSetOptions(solver=solver), narrow)
        for solver in ("exact", "random")
    )
    assert exact.is_optimal
    assert len(exact.chosen) <= len(drawn.chosen)


@pytest.mark.parametrize("seed", range(5))
def test_the_paper_s_solver_is_left_as_it_is(exact, seed):
    graph = random_graph(exact.images, seed)
    plain = SOLVERS["random"](DominationProblem(graph.adjacency()), seed=seed)
    assert dominating_set(graph, DominatingSetOptions(solver="random", seed=seed, best=True)) == plain


@every_solver
@pytest.mark.parametrize("seed", range(8))
def test_of_sets_of_one_size_one_with_small_errors_is_taken(solver, seed):
    if solver == "random":
        return
    graph = random_graph([f"{i:02d}" for i in range(20)], seed)
    plain = SOLVERS[solver](DominationProblem(graph.adjacency()))
    ours, best = (
        dominating_set(graph, DominatingSetOptions(solver=solver, best=best)) for best in (False, True)
    )
    assert ours.cost == plain.cost == best.cost == len(ours.chosen)
    assert ours.is_optimal == plain.is_optimal
    assert total_error(graph, ours.chosen) <= total_error(graph, plain.chosen)
    assert (
        best.error == total_error(graph, best.chosen) <= total_error(graph, ours.chosen) or solver == "greedy"
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("dominators", [1, 2, 3])
def test_each_dropped_image_keeps_as_many_kept_ones_that_localize_it_as_it_can(exact, seed, dominators):
    graph = random_graph(exact.images, seed)
    kept = chosen_by(graph, dominators=dominators)
    localizes = graph.adjacency().toarray()
    for v in set(range(len(graph.names))) - set(kept):
        assert localizes[list(kept), v].sum() >= min(dominators, localizes[:, v].sum()) > 0


def test_a_limit_on_images_is_kept_and_one_that_suffices_changes_nothing(narrow, narrow_graph):
    plain = chosen_by(narrow_graph)
    for limit in range(1, 11):
        found = dominating_set(narrow_graph, DominatingSetOptions(max_images=limit))
        assert len(found.chosen) <= limit
        assert (found.unmet == 0) == (limit >= len(plain))
        if limit >= len(plain):
            assert found.chosen == plain
    assert len(reduced_by(narrow, narrow_graph, max_images=1).images) == 1


def test_costs_of_observations_make_images_with_fewer_of_them_preferred(narrow, narrow_graph):
    sizes = np.array([len(seen.rows) for seen in narrow.observations.values()])
    cheapest = dominating_set(narrow_graph, DominatingSetOptions(cost="observations"), narrow)
    assert cheapest.cost == sizes[list(cheapest.chosen)].sum() <= sizes[list(chosen_by(narrow_graph))].sum()
    assert cheapest.is_optimal


@pytest.mark.parametrize("solver", ["exact", "greedy", "random"])
def test_with_the_rim_every_group_keeps_an_image_at_no_fewer_images(narrow, narrow_graph, solver):
    groups = rim_groups(narrow, narrow_graph.adjacency()).toarray()
    kept = chosen_by(narrow_graph, narrow, solver=solver, rim=True)
    assert groups[:, list(kept)].any(axis=1).all()
    assert dominates(narrow_graph.adjacency(), kept)
    assert len(kept) >= dominating_set(narrow_graph, DominatingSetOptions()).lower_bound


@pytest.mark.parametrize("options", [{"rim": True}, {"cost": "observations"}], ids=str)
def test_what_needs_the_map_says_so(narrow_graph, options):
    with pytest.raises(ValueError, match="map must be given"):
        chosen_by(narrow_graph, **options)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_starts_with_the_dominating_set_and_has_every_image_once(exact, seed):
    graph = random_graph(exact.images, seed)
    order = image_order(graph, DominatingSetOptions())
    kept = {graph.names[i] for i in chosen_by(graph)}
    assert set(order[: len(kept)]) == kept
    assert sorted(order) == list(graph.names)


@pytest.mark.parametrize("limit", range(-1, 12))
def test_the_longest_beginning_that_fits_is_found(limit):
    order = tuple("qwertzuiop")
    asked = []

    def fits(names):
        asked.append(names)
        return len(names) <= limit

    assert images_within(order, fits) == order[: max(limit, 0)]
    assert len(asked) <= 4


@pytest.mark.parametrize("change", ["names", "order", "fewer"])
def test_a_graph_of_another_map_is_refused(exact, change):
    names = {
        "names": tuple(f"x{name}" for name in exact.images),
        "order": tuple(reversed(exact.images)),
        "fewer": tuple(exact.images)[:-1],
    }[change]
    graph = graph_from_dense(names, np.zeros((len(names), len(names))))
    with pytest.raises(ValueError, match="graph must have the images of this map"):
        dominating_set(graph, DominatingSetOptions(), exact)


def test_random_images_follow_the_seed(exact):
    draws = [tuple(keep_random_images(exact, 3, seed=seed).images) for seed in range(20)]
    assert draws == [tuple(keep_random_images(exact, 3, seed=seed).images) for seed in range(20)]
    assert len(set(draws)) > 5
    assert {name for draw in draws for name in draw} == set(exact.images)
    assert all(len(draw) == 3 and list(draw) == sorted(draw) for draw in draws)


def test_all_images_can_be_drawn_but_not_more_nor_none(exact):
    assert list(keep_random_images(exact, 6, seed=0).images) == list(exact.images)
    for count in (0, -1, 7):
        with pytest.raises(InputError, match=f"{count} random images cannot be drawn from the 6"):
            keep_random_images(exact, count, seed=0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"threshold": 0.0}, "threshold must be positive, got 0.0"),
        ({"threshold": float("nan")}, "threshold must be positive, got nan"),
        ({"solver": "oracle"}, "solver must be one of cpsat, exact, greedy, random, got 'oracle'"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"dominators": 0}, "dominators must be at least 1, got 0"),
        ({"max_images": 0}, "max_images must be at least 1, got 0"),
        ({"max_images": 3, "cost": "observations"}, "cost must be image, got 'observations'"),
    ],
)
def test_bad_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        replace(DominatingSetOptions(), **values)
