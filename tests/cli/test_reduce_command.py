"""`slimsfm reduce`: points by default, images or both on request, within limits."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from commands import Outcome, contents, slimsfm
from rendered import MAPPING_FRAMES
from scenes import exact_map, with_matches, with_shuffled_points
from slimsfm.features import unit_rows
from slimsfm.geometry import corner_error
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.reduction import DominatingSetOptions, dominating_set


@dataclass(frozen=True)
class Pointed:
    path: Path
    outcome: Outcome


REMEMBERED = 100  # bytes of an option in map.json, which remembers how a map was made


@pytest.fixture(scope="session")
def pointed(boulder, tmp_path_factory) -> Pointed:
    """The rendered object's map, reduced without further options."""
    path = tmp_path_factory.mktemp("pointed") / "slim"
    return Pointed(path, slimsfm("reduce", boulder.map_path, "-o", path))


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    """A map of eight images that see half of 240 points each, whose descriptors differ a little."""
    made, rng = with_matches(exact_map(8, 240, reach_deg=80)), np.random.default_rng(0)
    for one in made.features.values():
        noise = rng.normal(0, 0.03, one.descriptors.shape).astype(np.float32)
        one.descriptors[:] = unit_rows(one.descriptors + noise)
    path = tmp_path_factory.mktemp("small") / "map"
    write_map(made, path)
    return path


@pytest.fixture
def reduced_to(small, tmp_path):
    def make(*arguments):
        done = slimsfm("reduce", small, "-o", tmp_path / "slim", *arguments)
        assert (done.code, done.err.strip()) == (0, "")
        return read_map(tmp_path / "slim"), bytes_by_part(tmp_path / "slim")["total"]

    return make


@pytest.fixture
def refused(small, tmp_path):
    """Checks that a refused command leaves nothing behind."""

    def check(*arguments, naming):
        before = contents(tmp_path)
        outcome = slimsfm("reduce", small, "-o", tmp_path / "slim", *arguments)
        lines = [line for line in outcome.err.splitlines() if line.strip()]
        assert (outcome.code, len(lines)) == (2, 1)
        assert lines[0].startswith("slimsfm: ")
        assert naming in lines[0]
        assert contents(tmp_path) == before

    return check


def test_without_options_it_keeps_points_for_direct_matching(boulder, pointed):
    assert (pointed.outcome.code, pointed.outcome.err.strip()) == (0, "")
    *_, promise, speed, last, next_line = pointed.outcome.out.splitlines()
    assert "predicted to localize 1" in promise
    assert "after 40 % hidden of what the full map does, with a median corner error of " in promise
    assert " times the full map's (measured on " in promise
    assert f"(measured on {MAPPING_FRAMES} images left out)" in promise
    assert speed.startswith("a whole query, from pixels to pose: ")
    assert " exhaustive on the full map (" in speed
    assert " progressive, the default of localize, on the full map (" in speed
    assert last.startswith(f"{pointed.path}: written in ")
    assert next_line == f"next: slimsfm localize {pointed.path} IMAGES -o poses.json"
    full, slim = boulder.map, read_map(pointed.path)
    assert slim.is_for_direct_matching
    assert set(slim.point3D_ids) < set(full.point3D_ids)
    assert list(slim.images) == list(full.images)
    assert sorted(path.name for path in pointed.path.iterdir()) == ["map.json", "points.npz", "sparse"]
    assert bytes_by_part(pointed.path)["total"] * 10 < bytes_by_part(boulder.map_path)["total"]


def test_the_model_of_points_opens_in_pycolmap(pointed):
    model = pycolmap.Reconstruction(pointed.path / "sparse")
    assert (model.num_reg_images(), model.num_points3D()) == (
        MAPPING_FRAMES,
        len(read_map(pointed.path).point3D_ids),
    )


def test_references_are_localized_by_points(boulder, pointed, tmp_path):
    output = tmp_path / "poses.json"
    done = slimsfm("localize", pointed.path, boulder.photos, "-o", output)
    assert done.code == 0, done.err
    truth = boulder.map
    found = [one for one in json.loads(output.read_text())["images"] if one["localized"]]
    assert len(found) >= 0.95 * MAPPING_FRAMES
    for one in found:
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(np.array(one["cam_from_world"]["quaternion_xyzw"])),
            np.array(one["cam_from_world"]["translation"]),
        )
        assert corner_error(pose, truth.images[one["name"]].cam_from_world(), truth.box) < 0.05


def test_a_map_of_points_is_described_and_refused_where_features_are_needed(pointed, tmp_path):
    facts = json.loads(slimsfm("info", pointed.path, "--json").out)
    assert facts["points"] == len(read_map(pointed.path).point3D_ids)
    assert facts["observations"] == 0
    before = contents(pointed.path)
    for command in (
        ("graph", pointed.path),
        ("reduce", pointed.path, "-o", tmp_path / "slim"),
        ("reduce", pointed.path, "-o", tmp_path / "slim", "--solver", "exact"),
        ("frontier", pointed.path),
        ("localize", pointed.path, tmp_path, "-o", tmp_path / "poses.json", "--strategy", "exhaustive"),
    ):
        refusal = slimsfm(*command)
        assert refusal.code == 2
    for command in (("graph", pointed.path), ("frontier", pointed.path)):
        (line,) = slimsfm(*command).err.splitlines()
        assert "direct matching alone" in line
        assert "use the map that it was reduced from" in line
    assert contents(pointed.path) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("use", ["direct", "both"])
def test_equal_reductions_are_equal_bytes(small, tmp_path, use):
    before = contents(small)
    for name in ("one", "two"):
        assert slimsfm("reduce", small, "-o", tmp_path / name, "--for", use).code == 0
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    kept = {name: data for name, data in contents(small).items() if not name.startswith("graph-")}
    assert kept == {name: data for name, data in before.items() if not name.startswith("graph-")}


def test_points_need_no_graph(boulder, a_map, tmp_path):
    del boulder
    for graph in a_map.glob("graph-*"):
        graph.unlink()
    done = slimsfm("reduce", a_map, "-o", tmp_path / "slim", "--selector", "random")
    assert done.code == 0
    assert "random (" in done.out
    assert not list(a_map.glob("graph-*"))


def test_for_images_it_keeps_images(small, reduced_to):
    slim, _ = reduced_to("--for", "images")
    full = read_map(small)
    assert slim.point_descriptors is None
    assert set(slim.images) < set(full.images)
    assert list(slim.features) == list(slim.images)


def test_for_both_it_keeps_images_and_points(reduced_to):
    who = ("--selector", "kcover")
    by_points, _ = reduced_to("--for", "direct", *who)
    by_images, _ = reduced_to("--for", "images", "--overwrite")
    both, _ = reduced_to("--for", "both", "--overwrite", *who)
    assert list(both.images) == list(by_images.images)
    direct = both.point3D_ids[both.point_descriptors.points]
    assert np.array_equal(direct, by_points.point3D_ids)
    assert set(both.point3D_ids) == set(direct) | set(by_images.point3D_ids)


def test_named_images_may_be_joined_by_points(reduced_to):
    both, _ = reduced_to("--images", "001.png", "004.png", "--for", "both", "--selector", "kcover")
    assert list(both.images) == ["001.png", "004.png"]
    assert len(both.point_descriptors.points) >= 100


def test_the_procedure_of_the_paper_is_followed_and_named(boulder, tmp_path):
    done = slimsfm("reduce", boulder.map_path, "-o", tmp_path / "slim", "--paper")
    assert done.code == 0, done.err
    map_ = boulder.map
    graph = compute_graph(map_, GraphOptions(edges="localize", candidates="all")).graph
    expected = dominating_set(graph, DominatingSetOptions(solver="random"), map_).chosen
    assert list(read_map(tmp_path / "slim").images) == [graph.names[i] for i in expected]
    assert "dominating (the paper's Algorithms 1 and 2: smallest of 1000 random sets" in done.out


@pytest.mark.parametrize("use", ["direct", "images"])
def test_it_keeps_to_a_largest_size(reduced_to, use):
    who = ("--selector", "random") if use == "direct" else ()
    _, first = reduced_to("--for", use, "--max-loss", "100%", *who)
    allowed = first + REMEMBERED
    _, second = reduced_to("--for", use, "--max-bytes", f"{allowed / 1000}kB", "--overwrite", *who)
    assert second <= allowed


def test_it_keeps_to_a_number_of_points(reduced_to):
    assert len(reduced_to("--max-points", 77, "--selector", "kcover")[0].point3D_ids) == 77


def test_it_keeps_to_a_number_of_images(reduced_to):
    most = len(reduced_to("--for", "images", "--max-loss", "100")[0].images)
    assert len(reduced_to("--for", "images", "--max-images", most, "--overwrite")[0].images) == most
    least = len(reduced_to("--solver", "exact", "--max-images", 1, "--overwrite")[0].images)
    assert least == 1


def test_a_larger_allowed_loss_gives_a_smaller_map(reduced_to):
    who = ("--selector", "random")
    careful, smallest, lossless = (
        len(reduced_to(*who, "--overwrite", *limit)[0].point3D_ids)
        for limit in ((), ("--max-loss", "100%"), ("--max-loss", "0"))
    )
    assert smallest <= lossless <= careful


def test_images_of_a_dominating_set_are_dropped_to_keep_to_a_size(reduced_to):
    slim, first = reduced_to("--solver", "exact")
    fewer, second = reduced_to("--solver", "exact", "--max-bytes", f"{first - 1}B", "--overwrite")
    assert second < first
    assert len(fewer.images) < len(slim.images)
    some, _ = reduced_to("--solver", "exact", "--max-points", len(slim.point3D_ids) - 1, "--overwrite")
    assert len(some.point3D_ids) < len(slim.point3D_ids)


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (
            ("--max-bytes", "1kB", "--selector", "random"),
            "no choice for direct meets max_bytes 1000; the nearest, random (100 points), has 100 points and",
        ),
        (("--max-ms", "0", "--selector", "random"), "no choice for direct meets max_ms 0"),
        (("--max-points", "0", "--selector", "random"), "no choice for direct meets max_points 0"),
        (("--for", "images", "--max-images", "0"), "no choice for images meets max_images 0"),
        (("--for", "both", "--max-bytes", "10 kB", "--selector", "random"), "no choice for"),
        (
            ("--solver", "exact", "--max-bytes", "1kB"),
            "no set of images meets max_bytes 1000; the nearest",
        ),
    ],
    ids=str,
)
def test_limits_that_cannot_be_met_are_refused_and_nothing_is_written(refused, arguments, naming):
    refused(*arguments, naming=naming)


def test_a_map_built_without_a_detector_keeps_a_dominating_set_with_its_photos(boulder, tmp_path):
    full = boulder.map
    photos = {name: np.full((24, 32, 3), row, np.uint8) for row, name in enumerate(full.images)}
    info = replace(full.info, extractor="loftr", extractor_options={"max_image_size": 640})
    write_map(replace(full, photos=photos, info=info, global_descriptors=None), tmp_path / "map")
    found = slimsfm("reduce", tmp_path / "map", "-o", tmp_path / "small")
    assert found.code == 0
    assert "dominating set" in found.out
    assert "no image is left out to predict by" in found.out
    small = read_map(tmp_path / "small")
    assert 1 <= len(small.images) < len(full.images)
    assert list(small.photos) == list(small.images)
    for command in (
        ("frontier", tmp_path / "map"),
        ("reduce", tmp_path / "map", "-o", tmp_path / "x", "--for", "both"),
    ):
        refused = slimsfm(*command)
        assert refused.code == 2
        assert "was built without a detector" in refused.err


def test_a_removed_selector_is_replaced_with_a_note(small, tmp_path):
    for name, selector in (("old", "probabilistic"), ("new", "kcover")):
        done = slimsfm("reduce", small, "-o", tmp_path / name, "--selector", selector)
        assert done.code == 0, done.err
        assert ("note: selector probabilistic has been removed; kcover is used instead" in done.out) == (
            name == "old"
        )
    assert contents(tmp_path / "old") == contents(tmp_path / "new")


def test_a_map_that_would_localize_nothing_is_not_written(tmp_path):
    write_map(with_shuffled_points(exact_map(4)), tmp_path / "map")
    outcome = slimsfm("reduce", tmp_path / "map", "-o", tmp_path / "slim")
    assert outcome.code == 2
    assert "would localize none of 4 images" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
