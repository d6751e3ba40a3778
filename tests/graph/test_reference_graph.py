import networkx as nx
import numpy as np
import pytest

from scenes import graph_from_dense
from slimsfm.graph import ReferenceGraph

ERRORS = [0.0, 0.001, 0.049, 0.05, 0.3, np.inf, np.inf, np.inf]
NAMES = ("a", "b", "c")


def random_errors(count, seed, share=1.0):
    rng = np.random.default_rng(seed)
    errors = rng.choice(ERRORS, (count, count))
    errors[rng.uniform(size=errors.shape) > share] = np.inf
    np.fill_diagonal(errors, 0)
    return errors


def graph_of_size(count, seed, share=1.0):
    names = tuple(f"{number:03d}" for number in range(count))
    return graph_from_dense(names, random_errors(count, seed, share))


def pairs_of(*rows):
    return np.array(rows, np.int64).reshape(-1, 2)


@pytest.mark.parametrize("count", [0, 1, 2, 20])
@pytest.mark.parametrize("seed", range(3))
def test_from_errors_and_dense_are_inverse(count, seed):
    errors = random_errors(count, seed)
    pairs = np.argwhere(~np.eye(count, dtype=bool)).reshape(-1, 2)
    order = np.random.default_rng(seed).permutation(len(pairs))
    pairs = pairs[order]
    graph = ReferenceGraph.from_errors(tuple(map(str, range(count))), pairs, errors[tuple(pairs.T)])
    assert np.array_equal(graph.dense(), errors)
    assert graph.errors.nnz == np.isfinite(errors).sum() - count
    assert graph.errors.has_canonical_format


def test_a_pair_that_is_not_given_has_no_pose():
    graph = ReferenceGraph.from_errors(NAMES, pairs_of((0, 2)), np.array([0.0]))
    assert graph.dense().tolist() == [[0, np.inf, 0], [np.inf, 0, np.inf], [np.inf, np.inf, 0]]
    empty = ReferenceGraph.from_errors(NAMES, pairs_of(), np.zeros(0))
    assert (empty.num_edges(), empty.num_components(), empty.isolated().all()) == (0, 3, True)


@pytest.mark.parametrize(
    ("pairs", "errors", "message"),
    [
        ([(0, 1)], [np.nan], "errors must be numbers from 0 to infinity"),
        ([(0, 1)], [-1e-9], "errors must be numbers from 0 to infinity"),
        ([(0, 3)], [0.1], "pairs must be from 0 to 2, got 0 and 3"),
        ([(-1, 0)], [0.1], "pairs must be from 0 to 2, got -1 and 0"),
        ([(1, 1)], [0.1], "pairs must join two different images"),
        ([(0, 1), (1, 0), (0, 1)], [0.1, 0.1, np.inf], "pairs must not repeat"),
    ],
)
def test_bad_errors_are_named(pairs, errors, message):
    with pytest.raises(ValueError, match=message):
        ReferenceGraph.from_errors(NAMES, pairs_of(*pairs), np.array(errors, np.float64))


@pytest.mark.parametrize("threshold", [0.01, 0.05, 1.0])
@pytest.mark.parametrize("share", [0.02, 0.1, 1.0])
def test_degrees_isolated_images_and_components_are_those_of_networkx(threshold, share):
    graph = graph_of_size(40, seed=5, share=share)
    known = nx.DiGraph()
    known.add_nodes_from(range(40))
    dense = graph.dense()
    known.add_edges_from((u, v) for u in range(40) for v in range(40) if u != v and dense[u, v] < threshold)
    out_degrees, in_degrees = graph.degrees(threshold)
    assert out_degrees.tolist() == [known.out_degree(node) for node in range(40)]
    assert in_degrees.tolist() == [known.in_degree(node) for node in range(40)]
    assert np.flatnonzero(graph.isolated(threshold)).tolist() == list(nx.isolates(known))
    assert graph.num_components(threshold) == nx.number_weakly_connected_components(known)
    assert graph.num_edges(threshold) == known.number_of_edges() == graph.adjacency(threshold).nnz
    assert np.array_equal(graph.adjacency(threshold).toarray(), nx.to_numpy_array(known) > 0)
