"""`slimsfm graph`, and `reduce` with the graph of another system."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from commands import contents, slimsfm
from slimsfm.cli.arguments import Execution
from slimsfm.domination import dominates
from slimsfm.errors import WorkError
from slimsfm.graph import EDGE_SOURCES, GraphOptions, compute_graph
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.graph.io import read_given_graph
from slimsfm.mapping.io import read_map, write_map

TRACKS = GraphOptions(edges="tracks")


@pytest.fixture
def bare(a_map):
    """A map without matches."""
    (a_map / "matches.h5").unlink()
    return a_map


@pytest.fixture
def refused(tmp_path):
    def check(*arguments, naming):
        before = contents(tmp_path)
        outcome = slimsfm(*arguments)
        assert outcome.code == 2
        (line,) = [line for line in outcome.err.splitlines() if line.strip()]
        assert line.startswith("slimsfm: ")
        assert naming in line
        assert contents(tmp_path) == before

    return check


def never(_items, label):
    raise AssertionError(f"{label}: computed though it was there")


@pytest.mark.parametrize("edges", sorted(EDGE_SOURCES))
def test_it_says_what_the_graph_is_like_and_keeps_it(a_map, tmp_path, edges):
    output, figures = tmp_path / "graph.npz", tmp_path / "figures.json"
    a_map = shutil.copytree(a_map, tmp_path / "fresh", ignore=shutil.ignore_patterns("graph-*"))
    done = slimsfm("graph", a_map, "--edges", edges, "-o", output, "--json", figures)
    assert (done.code, done.err.strip()) == (0, "")
    map_ = read_map(a_map)
    run = load_or_compute_graph(map_, a_map, GraphOptions(edges=edges), progress=never)
    graph, facts = run.graph, json.loads(figures.read_text())
    assert np.array_equal(read_given_graph(output, map_).dense(), graph.dense())
    degrees = graph.degrees()
    expected = {
        "images": 30,
        "pairs_tried": run.pairs_tried,
        "edges": graph.num_edges(),
        "density": graph.num_edges() / (30 * 29),
        "isolated": graph.isolated().sum(),
        "components": graph.num_components(),
        "out_degree": {"min": degrees[0].min(), "median": np.median(degrees[0]), "max": degrees[0].max()},
        "in_degree": {"min": degrees[1].min(), "median": np.median(degrees[1]), "max": degrees[1].max()},
    }
    assert list(facts.pop("seconds")) == ["candidates", "localize", "assemble"]
    assert facts == expected
    for name in ("images", "pairs_tried", "edges", "density", "isolated", "components"):
        assert any(line.split() == [name, str(facts[name])] for line in done.out.splitlines())
    assert ("recall" in done.out) == (edges == "localize")
    *_, last, next_line = done.out.splitlines()
    assert last.startswith(f"reference graph by {edges} in ")
    assert next_line.startswith("next: slimsfm reduce ")


def test_a_graph_that_is_kept_is_not_computed_again(a_map, tmp_path):
    assert slimsfm("graph", a_map).code == 0
    before = contents(a_map)
    again = slimsfm("graph", a_map, "--json", tmp_path / "figures.json")
    assert again.code == 0
    assert list(json.loads((tmp_path / "figures.json").read_text())["seconds"]) == ["read"]
    assert slimsfm("reduce", a_map, "-o", tmp_path / "slim", "--solver", "exact").code == 0
    assert contents(a_map) == before


@pytest.mark.parametrize("edges", ["tracks", "localize"])
def test_a_map_without_matches_has_other_ways(bare, edges):
    assert slimsfm("graph", bare, "--edges", edges).code == 0


def test_a_map_without_matches_is_told_so(refused, bare, tmp_path):
    naming = "has no matches; use --edges tracks or --edges localize"
    refused("graph", bare, "--edges", "matches", naming=naming)
    refused("reduce", bare, "-o", tmp_path / "slim", "--edges", "matches", naming=naming)


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (("--edges", "guess"), "'guess'"),
        (("--candidates", "some"), "'some'"),
        (("--threshold", "0"), "threshold must be positive, got 0.0"),
        (("--workers", "0"), "workers must be at least 1, got 0"),
        (("--min-inliers", "3"), "min_inliers must be at least 4, got 3"),
    ],
    ids=str,
)
def test_bad_options(refused, a_map, arguments, naming):
    refused("graph", a_map, *arguments, naming=naming)


@pytest.mark.parametrize("option", ["-o", "--json"])
def test_what_is_there_is_not_replaced_unasked(refused, a_map, tmp_path, option):
    taken = tmp_path / "taken.npz"
    taken.write_text("mine")
    refused("graph", a_map, option, taken, naming=str(taken))
    assert slimsfm("graph", a_map, option, taken, "--overwrite").code == 0
    assert taken.read_bytes() != b"mine"


def test_a_scheduler_that_does_not_answer(a_map):
    elsewhere = Execution(scheduler="tcp://127.0.0.1:1").open_executor()
    with pytest.raises(WorkError, match=r"^tcp://127\.0\.0\.1:1: no Dask scheduler answers there"):
        load_or_compute_graph(read_map(a_map), a_map, TRACKS, elsewhere, min_seconds=0.0)
    assert not (a_map / "graph-tracks.npz").exists()


def test_a_cluster_is_used(a_map, scheduler):
    elsewhere, map_ = Execution(scheduler=scheduler).open_executor(), read_map(a_map)
    run = load_or_compute_graph(map_, a_map, TRACKS, elsewhere, min_seconds=0.0)
    kept = load_or_compute_graph(map_, a_map, TRACKS, progress=never).graph
    assert np.array_equal(kept.dense(), run.graph.dense())
    assert np.array_equal(kept.dense(), compute_graph(map_, TRACKS).graph.dense())
    assert slimsfm("graph", a_map, "--edges", "tracks", "--scheduler", scheduler).code == 0


def test_reduce_uses_the_errors_of_another_system(exact, tmp_path):
    """By these errors the second image localizes all others, whatever the images show."""
    write_map(replace(exact, matches={}), tmp_path / "map")
    star = [f"002.png,{name},0.01" for name in exact.images if name != "002.png"]
    chain = [f"{a},{b},0.07" for a, b in zip(exact.images, list(exact.images)[1:], strict=False)]
    errors = tmp_path / "errors.csv"
    pairs = [*star, *(row for row in chain if not row.startswith("002"))]
    errors.write_text("\n".join(["reference,query,error", *pairs]) + "\n")
    done = slimsfm("reduce", tmp_path / "map", "-o", tmp_path / "slim", "--graph", errors)
    assert done.code == 0, done.err
    assert list(read_map(tmp_path / "slim").images) == ["002.png"]
    assert not list((tmp_path / "map").glob("graph-*"))
    graph = read_given_graph(errors, exact)
    assert dominates(graph.adjacency(), [1])
    assert graph.num_edges(0.1) == 9


def test_reduce_with_a_bad_graph(refused, a_map, tmp_path):
    errors = tmp_path / "errors.csv"
    arguments = ("reduce", a_map, "-o", tmp_path / "slim", "--graph")
    refused(*arguments, errors, naming=str(errors))
    errors.write_text("reference,query,error\n3.png,nobody.png,0.1\n")
    refused(*arguments, errors, naming="nobody.png")
