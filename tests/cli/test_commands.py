"""The whole path through the command line, on one small rendered object."""

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pycolmap
import pytest
from PIL import Image

from commands import contents, slimsfm
from rendered import MAPPING_FRAMES, NAME, QUERY_FRAMES
from slimsfm.cli import COMMANDS
from slimsfm.domination import dominates
from slimsfm.features import EXTRACTORS
from slimsfm.geometry import corner_error
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.localization.calibration import CALIBRATED
from slimsfm.mapping.io import read_map


def assert_done(outcome, made, next_command=None):
    """A command ends with what it made and how long that took, and with what to do next."""
    assert (outcome.code, outcome.err.strip()) == (0, "")
    lines = outcome.out.splitlines()
    if next_command:
        assert lines.pop().startswith(f"next: slimsfm {next_command} ")
    assert lines[-1].startswith(str(made))
    assert lines[-1].endswith(" s")


def poses_of(path):
    images = json.loads(path.read_text())["images"]
    return {
        image["name"]: pycolmap.Rigid3d(
            pycolmap.Rotation3d(np.array(image["cam_from_world"]["quaternion_xyzw"])),
            np.array(image["cam_from_world"]["translation"]),
        )
        for image in images
        if image["localized"]
    }


def test_synthesize(boulder):
    assert_done(boulder.synthesize, boulder.folder / "objects", "build")
    assert f"1 object, {MAPPING_FRAMES + QUERY_FRAMES} frames" in boulder.synthesize.out
    assert len(list(boulder.photos.iterdir())) == MAPPING_FRAMES
    assert len(list(boulder.queries.iterdir())) == QUERY_FRAMES
    assert sorted(path.name for path in (boulder.folder / "objects").iterdir()) == [NAME]


def test_build_and_info(boulder, tmp_path):
    built = slimsfm("build", boulder.photos, "-o", tmp_path / "map")
    assert_done(built, tmp_path / "map", "reduce")
    facts = json.loads(slimsfm("info", tmp_path / "map", "--json").out)
    map_ = read_map(tmp_path / "map")
    assert facts["images"] == list(map_.images)
    assert len(facts["images"]) > MAPPING_FRAMES / 2
    assert facts["points"] == len(map_.point3D_ids)
    assert facts["observations"] == map_.model.compute_num_observations()
    assert facts["box"]["source"] == "estimated"
    assert facts["unit"] == "unknown"
    assert facts["extractor"]["name"] == "sift"
    assert facts["verified_pairs"] == len(map_.matches) > 0
    sizes = {name: size for name, size in facts["bytes"].items() if name != "total"}
    assert facts["bytes"]["total"] == sum(sizes.values()) > 0
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
    listed = slimsfm("info", tmp_path / "map", "--images").out
    assert all(name in listed for name in facts["images"])
    assert facts["images"][0] not in slimsfm("info", tmp_path / "map").out


@pytest.mark.parametrize("extractor", [*EXTRACTORS, "of-a-plug-in"])
def test_info_says_whose_confidence_is_not_calibrated(a_map, extractor):
    stored = json.loads((a_map / "map.json").read_text())
    stored["extractor"] = {"name": extractor, "options": {}}
    del stored["checksums"]
    (a_map / "map.json").write_text(json.dumps(stored))
    said = " ".join(slimsfm("info", a_map).out.split())
    assert f"extractor {extractor}" in said
    assert ("confidence not calibrated for this extractor" in said) == (extractor not in CALIBRATED)
    facts = json.loads(slimsfm("info", a_map, "--json").out)
    assert facts["extractor"]["confidence_calibrated"] == (extractor in CALIBRATED)


def test_info_says_what_kind_of_map_it_is(boulder, tmp_path):
    small = tmp_path / "small"
    arguments = ("--max-points", 60, "--selector", "kcover")
    assert slimsfm("reduce", boulder.map_path, "-o", small, *arguments).code == 0
    said = slimsfm("info", small).out
    assert re.search(
        r"^map +\d+ points for direct matching, reduced from \d+ images \(.+\)$", said, re.MULTILINE
    )
    assert re.search(r"^points +60 points$", said, re.MULTILINE)
    assert "observation" not in said
    full = slimsfm("info", boulder.map_path).out
    assert re.search(r"^map +\d+ images with \d+ points \(.+\)$", full, re.MULTILINE)
    assert re.search(r"^box +given, diagonal \d\.\d+ metre$", full, re.MULTILINE)
    assert re.search(r"mean reprojection error \d\.\d\d px", full)


def test_reduce_keeps_a_dominating_set(boulder, reduced):
    assert_done(reduced.outcome, reduced.path, "localize")
    assert "proven smallest" in reduced.outcome.out
    full, slim = boulder.map, read_map(reduced.path)
    graph = load_or_compute_graph(full, reduced.graph.parent, progress=_never).graph
    kept = [graph.names.index(name) for name in slim.images]
    assert dominates(graph.adjacency(), kept)
    assert 1 <= len(kept) < MAPPING_FRAMES
    assert "dominating (exact, k = 1): " in reduced.outcome.out


def _never(_items, label):
    raise AssertionError(f"{label}: computed although it is stored")


def test_another_threshold_reuses_the_graph(reduced, boulder, tmp_path):
    before = reduced.graph.read_bytes(), reduced.graph.stat().st_mtime_ns
    loose = slimsfm("reduce", boulder.map_path, "-o", tmp_path / "loose", "--threshold", 0.2)
    assert loose.code == 0
    assert (reduced.graph.read_bytes(), reduced.graph.stat().st_mtime_ns) == before
    assert len(read_map(tmp_path / "loose").images) <= len(read_map(reduced.path).images)


def test_equal_reductions_are_equal_bytes(reduced, boulder, tmp_path):
    slimsfm("reduce", boulder.map_path, "-o", tmp_path / "again", "--solver", "exact")
    assert contents(tmp_path / "again") == contents(reduced.path)


def test_reduce_to_named_and_to_random_images(boulder, tmp_path):
    named = slimsfm("reduce", boulder.map_path, "-o", tmp_path / "named", "--images", "3.png", "11.png")
    assert_done(named, tmp_path / "named", "localize")
    assert list(read_map(tmp_path / "named").images) == ["11.png", "3.png"]
    drawn = slimsfm("reduce", boulder.map_path, "-o", tmp_path / "drawn", "--random", 5)
    assert_done(drawn, tmp_path / "drawn", "localize")
    assert len(read_map(tmp_path / "drawn").images) == 5


@pytest.mark.parametrize("strategy", ["exhaustive", "direct", "progressive", "retrieval"])
def test_localize_references_in_full_and_slim_map(boulder, tmp_path, strategy):
    slim = tmp_path / "slim"
    assert slimsfm("reduce", boulder.map_path, "-o", slim, "--edges", "localize").code == 0
    truth, photos = boulder.map, tmp_path / "photos"
    photos.mkdir()
    for path in boulder.mapping.image_paths[::3]:
        shutil.copy(path, photos)
    for map_path in (boulder.map_path, slim):
        output = tmp_path / f"{map_path.name}.json"
        done = slimsfm("localize", map_path, photos, "-o", output, "--strategy", strategy)
        assert_done(done, output)
        found = poses_of(output)
        errors = [
            corner_error(pose, truth.images[name].cam_from_world(), truth.box) for name, pose in found.items()
        ]
        assert len(found) == MAPPING_FRAMES / 3
        assert max(errors) < 0.05


def test_localize_one_image_with_its_camera(boulder, tmp_path):
    camera = boulder.mapping.cameras[0]
    line = f"1 {camera.model_name} {camera.width} {camera.height} {' '.join(map(str, camera.params))}\n"
    (tmp_path / "camera.txt").write_text(line)
    one, output = boulder.photos / "12.png", tmp_path / "pose.csv"
    done = slimsfm("localize", boulder.map_path, one, "-o", output, "--camera", tmp_path / "camera.txt")
    assert_done(done, output)
    assert "1 of 1 image localized" in done.out
    assert len(output.read_text().splitlines()) == 2


def test_any_number_of_workers_gives_the_same_poses(boulder, tmp_path):
    found = []
    for workers in (1, 3):
        output = tmp_path / f"{workers}.tum"
        slimsfm("localize", boulder.map_path, boulder.queries, "-o", output, "--workers", workers)
        found.append(output.read_bytes())
    assert found[0] == found[1]
    assert found[0]


def test_several_objects_are_found_at_once(boulder, tmp_path):
    twin = shutil.copytree(boulder.map_path, tmp_path / "twin")
    output = tmp_path / "poses.json"
    done = slimsfm("localize", boulder.map_path, boulder.queries, "-o", output, "--also", twin)
    assert_done(done, output)
    rows = json.loads(output.read_text())["images"]
    assert [row["object"] for row in rows] == ["map", "twin"] * QUERY_FRAMES
    for one, other in zip(rows[::2], rows[1::2], strict=True):
        assert one["name"] == other["name"]
        assert one["cam_from_world"] == other["cam_from_world"]
        assert one["ms_extract"] > 10 * other["ms_extract"]
    refused = slimsfm("localize", boulder.map_path, boulder.queries, "-o", tmp_path / "a.txt", "--also", twin)
    assert refused.code == 2
    assert "several objects are written as .json or .csv" in refused.err


def test_a_pose_says_how_sure_and_exact_it_is(boulder, tmp_path):
    slimsfm("localize", boulder.map_path, boulder.queries, "-o", tmp_path / "poses.json")
    rows = json.loads((tmp_path / "poses.json").read_text())["images"]
    localized = [row for row in rows if row["localized"]]
    assert localized
    for row in localized:
        assert 0.5 <= row["confidence"] <= 1
        assert 0 < row["predicted_corner_error"] < 0.1
        assert np.array(row["covariance"]).shape == (6, 6)
        assert 0 < row["position_bound_95"] < boulder.map.box.diagonal
        assert 0 < row["rotation_bound_95_deg"] < 10
        assert (row["camera_source"], row["camera_estimated"]) == ("map", [])
        assert row["focal_length_px"] == pytest.approx(boulder.map.shared_camera.mean_focal_length())


def test_an_unknown_focal_length_is_estimated(boulder, tmp_path):
    output = tmp_path / "poses.json"
    camera = tmp_path / "camera.txt"
    camera.write_text("1 SIMPLE_PINHOLE 320 240 400 160 120\n")
    arguments = ("--camera", camera, "--focal", "unknown")
    slimsfm("localize", boulder.map_path, boulder.mapping.image_paths[12], "-o", output, *arguments)
    (row,) = json.loads(output.read_text())["images"]
    assert row["focal_length_px"] == pytest.approx(boulder.map.shared_camera.mean_focal_length(), rel=0.03)


def test_gravity_must_agree_with_the_pose(boulder, tmp_path):
    path = boulder.mapping.image_paths[12]
    down = boulder.map.images[path.name].cam_from_world().rotation.matrix() @ [0.0, 0.0, -1.0]
    gravity = tmp_path / "gravity.json"
    for in_cam, localized in ((down, True), (-down, False)):
        gravity.write_text(json.dumps({"world": [0, 0, -1], "images": {path.name: in_cam.tolist()}}))
        output = tmp_path / f"{localized}.json"
        slimsfm("localize", boulder.map_path, path, "-o", output, "--gravity", gravity)
        (row,) = json.loads(output.read_text())["images"]
        assert row["localized"] is localized
    gravity.write_text("{}")
    refused = slimsfm("localize", boulder.map_path, path, "-o", tmp_path / "x.json", "--gravity", gravity)
    assert refused.code == 2
    assert "gravity.json: should hold" in refused.err
    assert not (tmp_path / "x.json").exists()


def test_images_without_the_object_are_not_localized(boulder, tmp_path):
    folder = tmp_path / "queries"
    folder.mkdir()
    Image.new("RGB", (320, 240)).save(folder / "black.png")
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    Image.fromarray(noise).save(folder / "noise.png")
    done = slimsfm("localize", boulder.map_path, folder, "-o", tmp_path / "poses.json")
    assert_done(done, tmp_path / "poses.json")
    assert "black.png: not localized" in done.out
    assert "noise.png: not localized" in done.out
    assert "0 of 2 images localized" in done.out
    assert poses_of(tmp_path / "poses.json") == {}


def test_import_brings_the_model_back(boulder, tmp_path):
    arguments = ("--features", boulder.map_path / "features.h5", "--matches", boulder.map_path / "matches.h5")
    done = slimsfm("import", boulder.map_path / "sparse", "-o", tmp_path / "map", *arguments)
    assert_done(done, tmp_path / "map", "reduce")
    assert list(read_map(tmp_path / "map").images) == list(boulder.map.images)
    assert len(read_map(tmp_path / "map").point3D_ids) == len(boulder.map.point3D_ids)


def test_overwrite_replaces_the_whole_map(boulder, tmp_path):
    for names in (("3.png", "11.png"), ("5.png",)):
        done = slimsfm("reduce", boulder.map_path, "-o", tmp_path / "slim", "--images", *names, "--overwrite")
        assert done.code == 0
    assert list(read_map(tmp_path / "slim").images) == ["5.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["slim"]


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)], ids=str)
def test_without_a_command_all_are_listed(arguments):
    outcome = slimsfm(*arguments)
    assert (outcome.code, outcome.err) == (0, "")
    assert all(f"  {name.split()[0]} " in outcome.out for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command):
    outcome = slimsfm(*command.split(), "--help")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith(f"usage: slimsfm {command} ")


def test_the_package_runs_as_a_module():
    found = subprocess.run([sys.executable, "-m", "slimsfm", "--version"], capture_output=True, text=True)
    assert (found.returncode, found.stderr) == (0, "")
    assert found.stdout.startswith("slimsfm ")
    unknown = subprocess.run([sys.executable, "-m", "slimsfm", "shrink"], capture_output=True, text=True)
    assert (unknown.returncode, unknown.stdout) == (2, "")
    assert unknown.stderr.startswith("slimsfm: 'shrink' is not a command; choose one of build, import, ")


AND_NAME_LIBRARIES = """
import sys
from slimsfm.cli import main
try:
    main()
finally:
    libraries = ("numpy", "pycolmap", "scipy", "rich", "cv2")
    print([one for one in libraries if hasattr(sys.modules.get(one), "__file__")], file=sys.stderr)
"""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_the_same_without_the_libraries(command):
    """A process that only prints help imports none of them, and says what it says with all of them."""
    arguments = [sys.executable, "-c", AND_NAME_LIBRARIES, *command.split(), "--help"]
    found = subprocess.run(arguments, capture_output=True, text=True)
    assert (found.returncode, found.stderr) == (0, "[]\n")
    assert found.stdout == slimsfm(*command.split(), "--help").out


def test_help_groups_what_is_rarely_needed_and_shows_no_none():
    said = slimsfm("localize", "--help").out
    main, advanced = said.split("\nadvanced:\n")
    assert "None" not in said
    assert "--camera PATH" in main
    assert "--max-iterations N" in advanced
    assert "(default: auto)" in main


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (("biuld",), "'biuld' is not a command; did you mean build?"),
        (("benchmark", "image"), "'image' is not a subcommand of benchmark; did you mean images?"),
        (("export", "onx"), "'onx' is not a subcommand of export; did you mean onnx?"),
        (("localize", "--cmera", "x"), "--cmera is not an option; did you mean --camera?"),
    ],
    ids=str,
)
def test_a_misspelled_word_is_answered_by_the_nearest(typed, meant):
    outcome = slimsfm(*typed)
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith(f"slimsfm: {meant}")
    assert len(outcome.err.splitlines()) == 1


@pytest.mark.parametrize("arguments", ["localize --help", "--help", "methods"])
def test_a_reader_that_stops_early_sees_no_traceback(arguments):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "slimsfm", *arguments.split()]
    found = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert found.stderr == ""
    assert found.returncode == 141


def test_options_may_be_written_with_underscores_and_equal_signs(boulder, tmp_path):
    output = tmp_path / "poses.csv"
    arguments = (boulder.photos / "12.png", f"--output={output}", "--min_confidence=0.6")
    assert slimsfm("localize", boulder.map_path, *arguments).code == 0
    assert len(output.read_text().splitlines()) == 2
