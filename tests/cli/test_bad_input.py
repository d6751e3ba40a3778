"""Every wrong input gives one line that names it, exit code 2, and writes or changes nothing."""

import json
import shutil

import pytest
from PIL import Image

from commands import contents, slimsfm
from slimsfm.selection import SELECTORS


@pytest.fixture
def refused(tmp_path):
    def check(*arguments, naming):
        before = contents(tmp_path)
        outcome = slimsfm(*arguments)
        lines = [line for line in outcome.err.splitlines() if line.strip()]
        assert outcome.code == 2
        assert len(lines) == 1
        assert lines[0].startswith("slimsfm: ")
        assert str(naming) in lines[0]
        assert len(lines[0]) < 500
        assert contents(tmp_path) == before

    return check


@pytest.fixture
def photos(boulder, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in boulder.mapping.image_paths[10:13]:
        shutil.copy(path, folder)
    return folder


def truncated(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def test_an_unknown_command(refused):
    refused("shrink", "x", naming="'shrink'")
    refused("benchmark", "movies", naming="'movies'")


@pytest.mark.parametrize("command", ["build", "localize", "benchmark"])
def test_a_folder_without_images(refused, boulder, tmp_path, command):
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("no image")
    before = {
        "build": ("build",),
        "localize": ("localize", boulder.map_path),
        "benchmark": ("benchmark", "images"),
    }
    refused(*before[command], empty, "-o", tmp_path / "out.json", naming=empty)
    refused(*before[command], tmp_path / "missing", "-o", tmp_path / "out.json", naming=tmp_path / "missing")


def test_a_single_photo_to_build(refused, photos, tmp_path):
    for path in sorted(photos.iterdir())[1:]:
        path.unlink()
    refused("build", photos, "-o", tmp_path / "map", naming=f"{photos}: holds 1 image")


def test_a_text_file_named_jpg(refused, boulder, photos, tmp_path):
    bad = photos / "text.jpg"
    bad.write_text("this is not an image")
    refused("build", photos, "-o", tmp_path / "map", "--strict", naming=bad)
    refused("localize", boulder.map_path, photos, "-o", tmp_path / "poses.json", "--strict", naming=bad)
    refused("localize", boulder.map_path, bad, "-o", tmp_path / "poses.json", naming=bad)
    refused("benchmark", "images", photos, "-o", tmp_path / "results", "--build.strict", naming=bad)


def test_a_truncated_image(refused, boulder, photos, tmp_path):
    bad = truncated(photos / "12.png")
    refused("build", photos, "-o", tmp_path / "map", "--strict", naming=bad)
    refused("localize", boulder.map_path, bad, "-o", tmp_path / "poses.json", naming=bad)


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_truncated_model(refused, a_map, tmp_path, part):
    bad = truncated(a_map / "sparse" / part)
    features = ("--features", a_map / "features.h5")
    refused("import", a_map / "sparse", "-o", tmp_path / "new", *features, naming=bad)
    refused("reduce", a_map, "-o", tmp_path / "slim", naming=bad)
    refused("info", a_map, naming=bad)
    refused("localize", a_map, tmp_path, "-o", tmp_path / "poses.json", naming=bad)


@pytest.mark.parametrize("part", ["features.h5", "map.json"])
def test_another_part_of_a_map_truncated_or_missing(refused, a_map, tmp_path, part):
    truncated(a_map / part)
    refused("info", a_map, naming=a_map / part)
    (a_map / part).unlink()
    refused("reduce", a_map, "-o", tmp_path / "slim", naming=a_map)


def test_a_map_of_a_later_format(refused, a_map, tmp_path):
    facts = json.loads((a_map / "map.json").read_text())
    (a_map / "map.json").write_text(json.dumps({**facts, "format_version": 99}))
    refused("reduce", a_map, "-o", tmp_path / "slim", naming="upgrade slimsfm")


def test_a_missing_map(refused, boulder, tmp_path):
    missing = tmp_path / "nowhere"
    refused("info", missing, naming=missing)
    refused("reduce", missing, "-o", tmp_path / "slim", naming=missing)
    refused("frontier", missing, naming=missing)
    refused("localize", missing, boulder.queries, "-o", tmp_path / "poses.json", naming=missing)
    refused("info", boulder.queries / "0.png", naming="not a map")


def test_images_that_lack_some_of_the_model(refused, boulder, photos, tmp_path):
    arguments = (boulder.map_path / "sparse", "-o", tmp_path / "map", "--images", photos)
    refused("import", *arguments, naming=photos)
    refused("import", *arguments[:-1], tmp_path / "missing", naming=tmp_path / "missing")


def test_an_import_without_or_with_two_sources(refused, boulder, tmp_path):
    model = boulder.map_path / "sparse"
    refused("import", model, "-o", tmp_path / "map", naming=model)
    both = ("--features", boulder.map_path / "features.h5", "--images", boulder.photos)
    refused("import", model, "-o", tmp_path / "map", *both, naming="features and images")
    lone = ("--matches", boulder.map_path / "matches.h5")
    refused("import", model, "-o", tmp_path / "map", *lone, naming="matches needs features")


def test_a_map_of_one_image_cannot_be_reduced(refused, boulder, tmp_path):
    assert slimsfm("reduce", boulder.map_path, "-o", tmp_path / "one", "--images", "3.png").code == 0
    refused("reduce", tmp_path / "one", "-o", tmp_path / "slim", naming=tmp_path / "one")
    refused("frontier", tmp_path / "one", naming=tmp_path / "one")


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (("--solver", "oracle"), "solver must be one of cpsat, exact, greedy, random, got 'oracle'"),
        (("--threshold", "-1"), "threshold must be positive, got -1.0"),
        (("--threshold", "nan"), "threshold must be positive, got nan"),
        (("--threshold", "high"), "--threshold"),
        (("--seed", "-1"), "seed must not be negative, got -1"),
        (("--seed", "-1", "--random", "3"), "seed must not be negative, got -1"),
        (("--seed", "-1", "--solver", "exact"), "seed must not be negative, got -1"),
        (("--random", "31"), "31 random images"),
        (("--random", "0"), "0 random images"),
        (("--images", "3.png", "nobody.png"), "'nobody.png'"),
        (("--images", "3.png", "--random", "2"), "excludes all other ways"),
        (("--images", "3.png", "--solver", "exact"), "excludes all other ways"),
        (("--random", "2", "--paper"), "excludes all other ways"),
        (("--paper", "--solver", "exact"), "paper excludes all other ways"),
        (("--paper", "--rim"), "paper excludes all other ways"),
        (("--for", "fun"), "'fun'"),
        (("--selector", "oracle"), f"selector must be one of {', '.join(SELECTORS)}, got 'oracle'"),
        (("--selector", "random", "--for", "images"), "selector chooses points"),
        (("--selector", "random", "--solver", "exact"), "selector chooses points"),
        (("--max-bytes", "12 parsecs"), "max-bytes must be a size such as 100kB or 2MB, got '12 parsecs'"),
        (("--max-bytes", "-1"), "max-bytes"),
        (("--max-loss", "a little"), "max-loss must be a percentage such as 1%, got 'a little'"),
        (("--max-loss", "1 kB"), "max-loss must be a percentage"),
        (("--max-error", "5 cm"), "max-error must be a length such as 0.05 or 0.01d, got '5 cm'"),
        (("--max-p90-factor", "-1"), "max_p90_factor must not be negative, got -1.0"),
        (("--max-error", "1d", "--random", "2"), "random leaves nothing to choose, so max_relative_error"),
        (("--max-ms", "-1"), "max_ms must not be negative, got -1.0"),
        (("--max-ms", "nan"), "max_ms must not be negative, got nan"),
        (("--max-points", "-1"), "max_points must not be negative, got -1"),
        (
            ("--max-loss", "1%", "--solver", "exact"),
            "max_loss needs several ways to choose images",
        ),
        (("--max-ms", "5", "--paper"), "max_ms needs several ways to choose images, but paper"),
        (("--max-images", "0", "--solver", "exact"), "max_images must be at least 1, got 0"),
        (("--max-images", "3", "--cost", "observations"), "cost must be image, got 'observations'"),
        (
            ("--max-bytes", "1kB", "--images", "3.png", "11.png"),
            "images leaves nothing to choose",
        ),
        (("--max-points", "100", "--random", "2"), "random leaves nothing to choose, so max_points"),
        (("--for", "direct", "--threshold", "0.1"), "threshold chooses images, but for direct"),
        (("--treshold", "0.1"), "--treshold"),
    ],
    ids=str,
)
def test_bad_options_of_reduce(refused, boulder, tmp_path, arguments, naming):
    refused("reduce", boulder.map_path, "-o", tmp_path / "slim", *arguments, naming=naming)


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (("--uses", "fun"), "uses must be among direct, images, got fun"),
        (("--selectors", "oracle"), f"selectors must be among {', '.join(SELECTORS)}, got oracle"),
        (("--budgets", "0"), "budgets must be positive, got (0,)"),
        (("--budgets", "many"), "--budgets"),
        (("--dominators", "0"), "dominators must be positive, got (0,)"),
        (("--seed", "-1"), "seed must not be negative, got -1"),
        (("--edges", "guess"), "'guess'"),
    ],
    ids=str,
)
def test_bad_options_of_frontier(refused, boulder, tmp_path, arguments, naming):
    output = tmp_path / "frontier.json"
    refused("frontier", boulder.map_path, "--json", output, *arguments, naming=naming)


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (
            ("--strategy", "guess"),
            "onepose, onepose++, progressive, retrieval, got 'guess'",
        ),
        (("--max-error-px", "0"), "max_error_px must be positive, got 0.0"),
        (("--min-inliers", "3"), "min_inliers must be at least 4, got 3"),
        (("--camera", "missing.txt"), "missing.txt"),
    ],
    ids=str,
)
def test_bad_options_of_localize(refused, boulder, tmp_path, arguments, naming):
    images = ("localize", boulder.map_path, boulder.queries)
    refused(*images, "-o", tmp_path / "poses.json", *arguments, naming=naming)


@pytest.mark.parametrize(
    ("command", "arguments", "naming"),
    [
        ("build", ("--max-features", "0"), "max_features must be at least 1, got 0"),
        ("build", ("--camera", "pinhole"), "'pinhole'"),
        ("build", ("--pairs", "some"), "'some'"),
        (
            "benchmark images",
            ("--strategies", "guess"),
            "strategy must be auto or one of direct, exhaustive, onepose, onepose++, progressive, ",
        ),
        ("benchmark images", ("--variants", "half"), "variants must be among"),
        ("benchmark images", ("--query-every", "0"), "--query-every 0"),
        ("benchmark images", ("--query-every", "1"), "--query-every 1"),
    ],
    ids=str,
)
def test_bad_options_of_commands_on_photos(refused, boulder, tmp_path, command, arguments, naming):
    refused(*command.split(), boulder.photos, "-o", tmp_path / "out", *arguments, naming=naming)


def test_bad_options_of_synthesize(refused, tmp_path):
    refused("synthesize", "-o", tmp_path / "out", "--objects", "teapot", naming="teapot")
    refused("synthesize", "-o", tmp_path / "out", "--width", 0, naming="width must be positive, got 0")


@pytest.mark.parametrize("command", ["build", "import", "reduce", "frontier", "localize", "synthesize"])
def test_missing_arguments(refused, command):
    refused(command, naming=f"see slimsfm {command} --help")


def test_outputs_of_an_unknown_format(refused, boulder, tmp_path):
    output = tmp_path / "poses.xml"
    refused("localize", boulder.map_path, boulder.queries, "-o", output, naming=output)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_output_that_exists(refused, boulder, tmp_path, kind):
    output = tmp_path / "taken.json"
    if kind == "file":
        output.write_text("mine")
    else:
        output.mkdir()
        (output / "notes.txt").write_text("mine")
    refused("reduce", boulder.map_path, "-o", output, naming=output)
    refused("frontier", boulder.map_path, "--json", output, naming=output)
    refused("frontier", boulder.map_path, "--curves", output, naming=output)
    refused("build", boulder.photos, "-o", output, naming=output)
    refused("localize", boulder.map_path, boulder.queries, "-o", output, naming=output)
    refused("import", boulder.map_path / "sparse", "-o", output, "--images", boulder.photos, naming=output)


def test_an_output_in_a_file(refused, boulder, tmp_path):
    (tmp_path / "file").write_text("mine")
    output = tmp_path / "file" / "slim"
    refused("reduce", boulder.map_path, "-o", output, naming=output)


def test_an_output_never_replaces_its_input(refused, a_map, photos, tmp_path):
    for output in (a_map, tmp_path, a_map / ".." / "map"):
        refused("reduce", a_map, "-o", output, "--overwrite", naming=output)
    link = tmp_path / "link"
    link.symlink_to(a_map)
    refused("reduce", a_map, "-o", link, "--overwrite", naming=link)
    refused("build", photos, "-o", photos, "--overwrite", naming=photos)
    refused("localize", a_map, photos, "-o", photos / "10.png", "--overwrite", naming=photos / "10.png")


@pytest.mark.parametrize("text", ["", "1 2 3\n", "[[0, 0, 0]]", '{"edges": 3}', "\n".join(["1 2 3"] * 8)])
def test_a_bad_box_file(refused, boulder, tmp_path, text):
    box = tmp_path / "box.json" if text[:1] in "[{" else tmp_path / "box.txt"
    box.write_text(text)
    arguments = (boulder.map_path / "sparse", "--features", boulder.map_path / "features.h5", "--box", box)
    refused("import", *arguments, "-o", tmp_path / "map", naming=box)


def test_a_bad_camera_file(refused, boulder, tmp_path):
    camera = tmp_path / "camera.txt"
    images = ("localize", boulder.map_path, boulder.queries, "-o", tmp_path / "poses.json")
    for text in ("1 PINWHEEL 320 240 300 300 160 120", "1 PINHOLE 320 240 300 300 160"):
        camera.write_text(text)
        refused(*images, "--camera", camera, naming=camera)
    camera.write_text("1 PINHOLE 240 320 300 300 120 160")
    refused(*images, "--camera", camera, naming="320x240")


def test_an_image_whose_focal_length_must_be_known_but_is_not(refused, boulder, tmp_path):
    upright = tmp_path / "upright.png"
    Image.new("RGB", (240, 320)).save(upright)
    arguments = ("localize", boulder.map_path, upright, "-o", tmp_path / "poses.json", "--focal", "known")
    refused(*arguments, naming="--camera FILE")


def test_no_output_lies_in_a_map_that_is_read(a_map, photos, tmp_path):
    before = contents(tmp_path)
    outcome = slimsfm("localize", a_map, photos, "-o", a_map / "map.json", "--overwrite")
    assert outcome.code == 2
    assert "map.json: lies in the map" in outcome.err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("command", ["info", "localize"])
@pytest.mark.parametrize("kind", ["circle", "long"])
def test_paths_that_cannot_be_are_named(photos, tmp_path, command, kind):
    path = tmp_path / ("x" * 300 if kind == "long" else "circle")
    if kind == "circle":
        path.symlink_to(path)
    options = (photos, "-o", tmp_path / "poses.json") if command == "localize" else ()
    outcome = slimsfm(command, path, *options)
    assert outcome.code == 2
    assert path.name in outcome.err
