import copy
from dataclasses import replace

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.features import NearestOptions
from slimsfm.geometry import Box
from slimsfm.graph import GraphOptions, ReferenceGraph, localize_pairs
from slimsfm.graph.io import graph_key, graph_of, read_graph, write_graph
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.pose import RansacOptions

GRAPH = ReferenceGraph(
    names=("a.png", "sub/ü b.png"), errors=np.array([[0.0, 0.0123456789012345], [np.inf, 0.0]])
)


def assert_equal_graphs(a, b):
    assert a.names == b.names
    assert np.array_equal(a.errors, b.errors)


def never(_items, label):
    raise AssertionError(f"{label}: computed though it was there")


def test_a_graph_is_read_as_it_was_written(tmp_path):
    write_graph(tmp_path / "graph.npz", GRAPH, "key")
    assert_equal_graphs(read_graph(tmp_path / "graph.npz", "key"), GRAPH)
    assert [path.name for path in tmp_path.iterdir()] == ["graph.npz"]


def test_a_graph_of_other_work_is_none(tmp_path):
    write_graph(tmp_path / "graph.npz", GRAPH, "key")
    assert read_graph(tmp_path / "graph.npz", "another key") is None
    assert read_graph(tmp_path / "missing.npz", "key") is None
    assert read_graph(tmp_path, "key") is None


def test_a_damaged_graph_is_none_and_never_a_wrong_one(tmp_path):
    path = tmp_path / "graph.npz"
    write_graph(path, GRAPH, "key")
    whole = path.read_bytes()
    for length in range(0, len(whole), 5):
        path.write_bytes(whole[:length])
        assert read_graph(path, "key") is None
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        graph = read_graph(path, "key")
        if graph is not None:
            assert_equal_graphs(graph, GRAPH)


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
        GraphOptions(matching=NearestOptions(max_ratio=0.9)),
        GraphOptions(ransac=RansacOptions(seed=1)),
        GraphOptions(ransac=RansacOptions(max_error_px=4.0)),
    ],
    ids=["ratio", "seed", "error"],
)
def test_other_options_make_another_key_and_compute_again(exact, options, tmp_path):
    path = tmp_path / "graph.npz"
    graph_of(exact, path)
    assert graph_key(exact, options) != graph_key(exact, GraphOptions())
    with pytest.raises(AssertionError, match="computed though"):
        graph_of(exact, path, options, progress=never)
    graph_of(exact, path, options)
    graph_of(exact, path, options, progress=never)


def test_a_graph_is_computed_once(exact, tmp_path):
    path = tmp_path / "graph.npz"
    first = graph_of(exact, path)
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    second = graph_of(exact, path, progress=never)
    assert_equal_graphs(first, second)
    assert_equal_graphs(first, localize_pairs(exact))
    for threshold in (0.01, 0.05, 0.5):
        assert second.adjacency(threshold).sum() == 36
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before


def test_a_graph_of_another_map_or_a_damaged_one_is_replaced(exact, tmp_path):
    path = tmp_path / "graph.npz"
    graph_of(exact_map(num_images=3), path)
    expected = localize_pairs(exact)
    assert_equal_graphs(graph_of(exact, path), expected)
    path.write_bytes(path.read_bytes()[:100])
    assert_equal_graphs(graph_of(exact, path), expected)
    assert_equal_graphs(graph_of(exact, path, progress=never), expected)
    part = keep_images(exact, ["001.png", "004.png"])
    assert graph_of(part, path).names == ("001.png", "004.png")


def test_without_a_path_nothing_is_kept(exact, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    graph_of(exact, None)
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_leaves_no_graph(exact, tmp_path):
    def interrupt(items, label):
        yield items[0]
        raise KeyboardInterrupt(label)

    with pytest.raises(KeyboardInterrupt):
        graph_of(exact, tmp_path / "graph.npz", progress=interrupt)
    assert list(tmp_path.iterdir()) == []
