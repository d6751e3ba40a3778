from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from scenes import algorithm_1, exact_map, graph_from_dense
from slimsfm.domination import SOLVERS, DominationProblem, dominates
from slimsfm.errors import InputError
from slimsfm.mapping.map import check_map
from slimsfm.reduction import ReductionOptions, keep_random_images, reduce_map

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


@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_kept_images_are_those_of_the_solver_and_localize_all_others(narrow, narrow_graph, solver):
    reduction = reduce_map(narrow, narrow_graph, ReductionOptions(solver=solver, seed=3))
    chosen = SOLVERS[solver](DominationProblem(narrow_graph.adjacency()), seed=3).chosen
    assert reduction.solution.chosen == chosen
    assert list(reduction.map.images) == [narrow_graph.names[i] for i in chosen]
    assert dominates(narrow_graph.adjacency(), chosen)
    as_networkx = nx.from_scipy_sparse_array(narrow_graph.adjacency(), create_using=nx.DiGraph)
    assert nx.is_dominating_set(as_networkx, chosen)
    assert 1 <= len(chosen) < 10


def test_kept_points_are_those_that_kept_images_see(narrow, narrow_graph):
    slim = reduce_map(narrow, narrow_graph).map
    check_map(slim)
    seen = {i for name in slim.images for i in narrow.point3D_ids[narrow.observations[name].points].tolist()}
    assert set(slim.point3D_ids.tolist()) == seen
    assert len(seen) < len(narrow.point3D_ids)
    for name, image in slim.images.items():
        assert np.array_equal(image.cam_from_world().matrix(), narrow.images[name].cam_from_world().matrix())


@pytest.mark.parametrize("solver", sorted(SOLVERS))
@pytest.mark.parametrize("seed", range(10))
def test_every_image_keeps_a_kept_one_that_localizes_it(exact, solver, seed):
    graph = random_graph(exact.images, seed)
    for threshold in (0.03, 0.05, 0.1):
        slim = reduce_map(exact, graph, ReductionOptions(threshold=threshold, solver=solver)).map
        kept = [graph.names.index(name) for name in slim.images]
        errors = graph.dense()
        for v in range(len(graph.names)):
            assert v in kept or any(errors[u, v] < threshold for u in kept)


@pytest.mark.parametrize("seed", range(10))
def test_a_larger_threshold_never_needs_more_images(exact, seed):
    graph = random_graph(exact.images, seed)
    sizes = [
        len(reduce_map(exact, graph, ReductionOptions(threshold=threshold)).solution.chosen)
        for threshold in (0.001, 0.03, 0.05, 0.06, 0.5, 1.0)
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] == len(exact.images)


def test_the_exact_solver_is_never_beaten(narrow, narrow_graph):
    exact, drawn = (
        reduce_map(narrow, narrow_graph, ReductionOptions(solver=solver)).solution
        for solver in ("exact", "random")
    )
    assert exact.is_optimal
    assert len(exact.chosen) <= len(drawn.chosen)


@pytest.mark.parametrize("change", ["names", "order", "fewer"])
def test_a_graph_of_another_map_is_refused(exact, change):
    names = {
        "names": tuple(f"x{name}" for name in exact.images),
        "order": tuple(reversed(exact.images)),
        "fewer": tuple(exact.images)[:-1],
    }[change]
    graph = graph_from_dense(names, np.zeros((len(names), len(names))))
    with pytest.raises(ValueError, match="graph must be of this map"):
        reduce_map(exact, graph)


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
        ({"solver": "oracle"}, "solver must be one of exact, random, got 'oracle'"),
        ({"seed": -1}, "seed must not be negative, got -1"),
    ],
)
def test_bad_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        replace(ReductionOptions(), **values)
