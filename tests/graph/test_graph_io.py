import copy
from dataclasses import replace

import numpy as np
import pytest

from scenes import ALGORITHM_1, algorithm_1, exact_map, graph_from_dense
from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.graph.edge_sources import graph_key
from slimsfm.graph.io import read_given_graph, write_graph
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.pose import RansacOptions

HEADER, RECORD = 65, 24  # bytes of a checkpoint
FILES = ["graph-localize.npz"]


def assert_equal_graphs(a, b):
    assert a.names == b.names
    assert np.array_equal(a.dense(), b.dense())


def never(_items, label):
    raise AssertionError(f"{label}: computed though it was there")


def is_kept(map_, folder, options=ALGORITHM_1):
    try:
        load_or_compute_graph(map_, folder, options, progress=never)
    except AssertionError:
        return False
    return True


@pytest.fixture
def few_points():
    """A map of three images, whose graph has edges and pairs without one."""
    return exact_map(num_images=3, num_points=60, reach_deg=70.0)


def test_a_graph_is_read_as_it_was_written(few_points, tmp_path):
    names = tuple(few_points.images)
    errors = np.array([[0.0, 0.0123456789012345, np.inf], [np.inf, 0.0, 0.0], [7.0, np.inf, 0.0]])
    write_graph(tmp_path / "graph.npz", graph_from_dense(names, errors))
    assert np.array_equal(read_given_graph(tmp_path / "graph.npz", few_points).dense(), errors)
    assert [path.name for path in tmp_path.iterdir()] == ["graph.npz"]


def test_a_damaged_graph_is_computed_again_and_never_a_wrong_one(few_points, tmp_path):
    expected = load_or_compute_graph(few_points, tmp_path, ALGORITHM_1).graph
    path = tmp_path / FILES[0]
    whole = path.read_bytes()
    for length in range(0, len(whole), 41):
        path.write_bytes(whole[:length])
        assert not is_kept(few_points, tmp_path)
    for position in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        if is_kept(few_points, tmp_path):
            assert_equal_graphs(load_or_compute_graph(few_points, tmp_path, ALGORITHM_1).graph, expected)
    path.write_bytes(whole)
    assert is_kept(few_points, tmp_path)


def changed_map(map_, change):
    model = copy.deepcopy(map_.model)
    info = map_.info
    if change == "pose":
        pose = model.image(1).cam_from_world()
        pose.translation = pose.translation + 1e-6
        model.image(1).frame.set_cam_from_world(1, pose)
    if change == "point":
        model.point3D(model.point3D_ids().copy().pop()).xyz = np.zeros(3)
    if change == "camera":
        model.camera(1).params = model.camera(1).params * 1.001
    if change == "name":
        model.image(1).name = "000.png"
        return replace(
            map_,
            model=model,
            matches={},
            features={model.image(i + 1).name: f for i, f in enumerate(map_.features.values())},
        )
    if change == "observation":
        model.delete_observation(1, 0)
    if change == "box":
        info = replace(info, box=Box(np.zeros(3), np.diag([1.0, 0.8, 0.61])))
    if change == "extractor":
        info = replace(info, extractor_options={"max_features": 7})
    return replace(map_, model=model, info=info)


@pytest.mark.parametrize("change", ["pose", "point", "camera", "name", "observation", "box", "extractor"])
def test_the_key_changes_with_the_map(exact, change):
    options = GraphOptions()
    assert graph_key(changed_map(exact, change), options) != graph_key(exact, options)


def test_the_key_of_equal_maps_is_equal(exact, tmp_path):
    write_map(exact, tmp_path / "map")
    for a, b in ((exact, changed_map(exact, "nothing")), [read_map(tmp_path / "map") for _ in "ab"]):
        assert graph_key(a, GraphOptions()) == graph_key(b, GraphOptions())


@pytest.mark.parametrize(
    "options",
    [
        GraphOptions(edges="localize", matcher="nearest"),
        GraphOptions(ransac=RansacOptions(seed=1)),
        GraphOptions(ransac=RansacOptions(max_error_px=4.0)),
    ],
    ids=["matcher", "seed", "error"],
)
def test_other_options_make_another_key_and_compute_again(exact, options, tmp_path):
    options = replace(options, edges="localize")
    load_or_compute_graph(exact, tmp_path, GraphOptions(edges="localize"))
    assert graph_key(exact, options) != graph_key(exact, GraphOptions(edges="localize"))
    assert not is_kept(exact, tmp_path, options)
    load_or_compute_graph(exact, tmp_path, options)
    assert is_kept(exact, tmp_path, options)


@pytest.mark.parametrize("edges", ["matches", "tracks", "localize"])
def test_another_threshold_reuses_a_graph_that_does_not_depend_on_it(exact, edges, tmp_path):
    load_or_compute_graph(exact, tmp_path, GraphOptions(edges=edges))
    assert is_kept(exact, tmp_path, GraphOptions(edges=edges, threshold=0.2))


def test_hybrid_looks_closer_around_another_threshold(exact, tmp_path):
    load_or_compute_graph(exact, tmp_path, GraphOptions(edges="hybrid"))
    assert not is_kept(exact, tmp_path, GraphOptions(edges="hybrid", threshold=0.2))


def test_a_graph_is_computed_once(exact, tmp_path):
    first = load_or_compute_graph(exact, tmp_path, ALGORITHM_1)
    path = tmp_path / FILES[0]
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    second = load_or_compute_graph(exact, tmp_path, ALGORITHM_1, progress=never)
    assert_equal_graphs(first.graph, second.graph)
    assert_equal_graphs(first.graph, algorithm_1(exact))
    assert first.pairs_tried == second.pairs_tried == 15
    for threshold in (0.01, 0.05, 0.5):
        assert second.graph.adjacency(threshold).sum() == 30
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    assert [found.name for found in tmp_path.iterdir()] == FILES


def test_a_graph_of_each_source_is_kept_beside_the_others(exact, tmp_path):
    sources = ("matches", "tracks", "localize", "hybrid")
    for edges in sources:
        load_or_compute_graph(exact, tmp_path, GraphOptions(edges=edges))
    assert all(is_kept(exact, tmp_path, GraphOptions(edges=edges)) for edges in sources)
    assert is_kept(exact, tmp_path, GraphOptions(edges="auto"))
    assert {path.name for path in tmp_path.iterdir()} == {f"graph-{edges}.npz" for edges in sources}


def test_a_graph_of_another_map_or_a_damaged_one_is_replaced(exact, tmp_path):
    load_or_compute_graph(exact_map(num_images=3), tmp_path, ALGORITHM_1)
    expected, path = algorithm_1(exact), tmp_path / FILES[0]
    assert_equal_graphs(load_or_compute_graph(exact, tmp_path, ALGORITHM_1).graph, expected)
    path.write_bytes(path.read_bytes()[:100])
    assert_equal_graphs(load_or_compute_graph(exact, tmp_path, ALGORITHM_1).graph, expected)
    assert_equal_graphs(load_or_compute_graph(exact, tmp_path, ALGORITHM_1, progress=never).graph, expected)
    part = keep_images(exact, ["001.png", "004.png"])
    assert load_or_compute_graph(part, tmp_path, ALGORITHM_1).graph.names == ("001.png", "004.png")


def test_an_interruption_leaves_only_the_progress(exact, tmp_path):
    one_pair = {"block_seconds": 0.0}

    def interrupt(items, label):
        yield items[0]
        raise KeyboardInterrupt(label)

    with pytest.raises(KeyboardInterrupt):
        load_or_compute_graph(exact, tmp_path, ALGORITHM_1, progress=interrupt, **one_pair)
    assert [path.name for path in tmp_path.iterdir()] == ["graph-localize.partial"]
    labels = []

    def watch(items, label):
        labels.append(label)
        return iter(items)

    kept = ((tmp_path / "graph-localize.partial").stat().st_size - HEADER) // RECORD
    resumed = load_or_compute_graph(exact, tmp_path, ALGORITHM_1, progress=watch, **one_pair)
    assert kept == 9  # 8 timed pairs and one block; the second run times all that is left
    assert labels == ["localize 0 pairs from each other, 1 at a time"]
    assert_equal_graphs(resumed.graph, algorithm_1(exact))
    assert [path.name for path in tmp_path.iterdir()] == FILES


CSV = "reference,query,error\n"


def test_errors_of_another_system_are_read_from_a_table(exact, tmp_path):
    path = tmp_path / "errors.csv"
    path.write_text(CSV + "001.png,002.png,0.5\n002.png,001.png,0.0\n003.png,001.png,inf\n")
    expected = np.full((6, 6), np.inf)
    np.fill_diagonal(expected, 0)
    expected[0, 1], expected[1, 0] = 0.5, 0.0
    assert np.array_equal(read_given_graph(path, exact).dense(), expected)
    path.write_text("\ufeffsource,error,query,reference\r\nx,0.25,001.png,006.png\r\n", encoding="utf-8")
    assert read_given_graph(path, exact).dense()[5, 0] == 0.25
    path.write_text(CSV)
    assert read_given_graph(path, exact).errors.nnz == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks one of the columns reference, query, error"),
        ("reference,image,error\n001.png,002.png,0.1\n", "lacks one of the columns reference, query, error"),
        (CSV + "001.png,nobody.png,0.1\n", "'nobody.png' is not an image of the map"),
        (CSV + "001.png\n", "None is not an image of the map"),
        (CSV + "001.png,002.png\n", "not a readable table"),
        (CSV + "001.png,002.png,small\n", "could not convert string to float: 'small'"),
        (CSV + "001.png,002.png,nan\n", "errors must be numbers from 0 to infinity"),
        (CSV + "001.png,002.png,-0.1\n", "errors must be numbers from 0 to infinity"),
        (CSV + "001.png,002.png,0.1\n001.png,002.png,0.1\n", "pairs must not repeat"),
        (CSV + "001.png,001.png,0.1\n", "pairs must join two different images"),
        (CSV + "001.png,\x00,0.1\n", "not a readable table|is not an image of the map"),
    ],
)
def test_a_bad_table_is_named(exact, tmp_path, text, message):
    path = tmp_path / "errors.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_given_graph(path, exact)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("name", ["errors.csv", "errors.npz"])
@pytest.mark.parametrize("kind", ["nothing", "another file", "folder"])
def test_what_is_no_graph_is_named(exact, tmp_path, name, kind):
    path = tmp_path / name
    if kind == "another file":
        path.write_bytes(b"\xff\xfe no graph")
    if kind == "folder":
        path.mkdir()
    with pytest.raises(InputError) as caught:
        read_given_graph(path, exact)
    assert str(caught.value).startswith(f"{path}: ")


SELF_PAIR = {"data": np.array([0.1]), "indices": np.array([1]), "indptr": np.array([0, 0, 1, 1, 1, 1, 1])}


@pytest.mark.parametrize(
    "change",
    [
        {"names": np.array(["a", "b", "c", "d", "e", "f"])},
        {"data": np.array([np.nan])},
        {"data": np.array([-1.0])},
        {"indices": np.array([6])},
        {"indices": np.array([-1])},
        {"indptr": np.array([0, 1])},
        SELF_PAIR,
        {"data": np.ones(2), "indices": np.array([1, 1]), "indptr": np.array([0, 2, 2, 2, 2, 2, 2])},
    ],
    ids=["names", "nan", "negative", "beyond", "below", "rows", "self pair", "repeated pair"],
)
def test_a_bad_graph_of_another_system_is_named(exact, tmp_path, change):
    good = {
        "names": np.array(list(exact.images)),
        "data": np.array([0.5]),
        "indices": np.array([1]),
        "indptr": np.array([0, 1, 1, 1, 1, 1, 1]),
    }
    path = tmp_path / "graph.npz"
    np.savez(path, **good)
    assert read_given_graph(path, exact).dense()[0, 1] == 0.5
    np.savez(path, **{**good, **change})
    with pytest.raises(InputError) as caught:
        read_given_graph(path, exact)
    assert str(caught.value).startswith(f"{path}: ")
    for part in good:
        np.savez(path, **{key: value for key, value in good.items() if key != part})
        with pytest.raises(InputError):
            read_given_graph(path, exact)


@pytest.mark.parametrize(
    ("edges", "ignored"),
    [
        ("matches", {"threshold": 0.1, "candidates": "all", "matcher": "nearest"}),
        ("tracks", {"threshold": 0.1, "candidates": "all", "matcher": "nearest"}),
        ("localize", {"threshold": 0.1}),
        ("hybrid", {"candidates": "all"}),
    ],
)
def test_a_graph_is_reused_when_only_options_change_that_its_source_ignores(exact, edges, ignored):
    options = GraphOptions(edges=edges)
    assert graph_key(exact, replace(options, **ignored)) == graph_key(exact, options)
    changed = replace(options, ransac=RansacOptions(seed=1))
    assert graph_key(exact, changed) != graph_key(exact, options)
