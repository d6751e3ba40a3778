import json
from dataclasses import replace

import numpy as np
import pytest

from commands import contents, slimsfm
from slimsfm.mapping import read_map, write_map
from slimsfm.mapping.subset import keep_images
from wrong_poses import laid_over, matched_map, swapped


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    right = matched_map()
    write_map(right, folder / "right")
    write_map(swapped(right, "001.png", "006.png"), folder / "wrong")
    write_map(keep_images(right, ["001.png", "002.png"]), folder / "reduced")
    return folder


def test_a_right_map_ends_with_0(maps):
    done = slimsfm("check", maps / "right")
    assert done.code == 0
    assert "wrong poses: none" in done.out


def test_wrong_poses_end_with_1_and_are_named(maps):
    before = contents(maps / "wrong")
    done = slimsfm("check", maps / "wrong")
    assert done.code == 1
    assert "wrong poses: 2" in done.out
    assert "001.png: 3 disjoint sets of references localize it" in done.out
    assert contents(maps / "wrong") == before


def test_json_has_every_finding_with_its_evidence(maps):
    done = slimsfm("check", maps / "wrong", "--json")
    found = json.loads(done.out)
    assert done.code == 1
    assert [one["name"] for one in found["wrong"]] == ["001.png", "006.png"]
    assert len(found["wrong"][0]["sets"]) == 3
    assert len(found["wrong"][0]["others_cam_from_world"]["translation"]) == 3
    assert found["repaired"] is None


def test_repair_writes_a_map_that_passes(maps, tmp_path):
    done = slimsfm("check", maps / "wrong", "--repair", "-o", tmp_path / "repaired")
    assert done.code == 0
    assert "set right: 001.png, 006.png" in done.out
    assert slimsfm("check", tmp_path / "repaired").code == 0


def test_misplaced_images_are_named_drawn_and_dropped(tmp_path):
    part = [f"{number:03d}.png" for number in range(25, 32)]
    folded = laid_over(matched_map(36, 200), part, 180)
    rng, matches = np.random.default_rng(0), dict(folded.matches)
    for pair in [pair for pair in matches if len({*pair} & {*part}) == 1]:
        rows = matches[pair]
        matches[pair] = np.stack([rows[:, 0], rng.permutation(rows[:, 1])], axis=1)
    write_map(replace(folded, matches=matches), tmp_path / "folded")
    done = slimsfm("check", tmp_path / "folded", "--json", "--figure", tmp_path / "cameras.svg")
    found = json.loads(done.out)
    assert (done.code, found["wrong"], [one["name"] for one in found["misplaced"]]) == (1, [], part)
    assert "7 of them wrong" in (tmp_path / "cameras.svg").read_text()
    done = slimsfm("check", tmp_path / "folded", "--repair", "-o", tmp_path / "repaired")
    assert (done.code, f"dropped: {', '.join(part)}" in done.out) == (0, True)
    assert not read_map(tmp_path / "repaired").images.keys() & set(part)


def test_output_without_repair_is_the_map_with_marks(maps, tmp_path):
    done = slimsfm("check", maps / "wrong", "-o", tmp_path / "marked")
    assert done.code == 1
    assert read_map(tmp_path / "marked").info.wrong_poses == ("001.png", "006.png")
    same = "features.h5", "matches.h5", "sparse/points3D.bin", "sparse/images.bin"
    written, given = contents(tmp_path / "marked"), contents(maps / "wrong")
    assert [written[name] for name in same] == [given[name] for name in same]
    assert (
        "`check` found the poses of 2 images ('001.png', '006.png') wrong"
        in slimsfm("info", tmp_path / "marked").out
    )


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_a_picture_is_written_and_equal_each_time(maps, tmp_path, suffix):
    files = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for file in files:
        assert slimsfm("check", maps / "wrong", "--figure", file).code == 1
    assert files[0].read_bytes() == files[1].read_bytes()
    assert suffix == ".png" or "001.png" in files[0].read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repair"], "--repair makes a map: give its folder with --output"),
        (["--figure", "cameras.bmp"], "cameras.bmp: not a supported figure format"),
        (["--images", "nowhere"], "nowhere/001.png"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(
    maps, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    done = slimsfm("check", maps / "right", *arguments)
    assert done.code == 2
    assert message in done.err
    assert done.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_reduced_map_is_refused(maps):
    done = slimsfm("check", maps / "reduced")
    assert (done.code, done.out) == (2, "")
    assert "check the map that it was reduced from" in done.err


def test_the_map_itself_is_never_the_output(maps):
    done = slimsfm("check", maps / "wrong", "--repair", "-o", maps / "wrong", "--overwrite")
    assert done.code == 2
    assert "choose another output" in done.err
