"""`slimsfm add` and `slimsfm forget`, and reductions that are repeated on a larger map."""

import json
import shutil

import pytest
from PIL import Image

from commands import slimsfm
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images


@pytest.fixture(scope="module")
def grown(boulder, tmp_path_factory):
    """A map of most of the images, the folder of the others, and the larger map."""
    folder = tmp_path_factory.mktemp("grown")
    taken = list(boulder.map.images)[3::8]
    write_map(
        keep_images(boulder.map, set(boulder.map.images) - set(taken), min_track_length=2), folder / "map"
    )
    (folder / "new").mkdir()
    for name in taken:
        shutil.copy(boulder.photos / name, folder / "new" / name)
    outcome = slimsfm("add", folder / "map", folder / "new", "-o", folder / "larger", "--workers", 1)
    assert outcome.code == 0, outcome.err
    return folder, taken, outcome


def test_add_says_what_was_gained(grown):
    folder, taken, outcome = grown
    assert "photos added in " in outcome.out
    assert "coverage: " in outcome.out
    assert "queries lost: " in outcome.out
    added = set(taken) & set(read_map(folder / "larger").images)
    assert len(added) >= 2
    assert all(f"not added: {name}: " in outcome.out for name in set(taken) - added)


def test_adding_again_copies_the_map(grown):
    folder, _, _ = grown
    outcome = slimsfm("add", folder / "larger", folder / "new", "-o", folder / "same")
    assert outcome.code == 0, outcome.err
    assert "nothing new" in outcome.out
    for path in (folder / "larger").rglob("*"):
        assert path.is_dir() or (folder / "same" / path.relative_to(folder / "larger")).read_bytes() == (
            path.read_bytes()
        )


def test_a_reduction_is_repeated_on_the_larger_map(grown):
    folder, _, _ = grown
    for arguments in (
        (folder / "map", "-o", folder / "small", "--selector", "kcover", "--max-points", 150),
        (folder / "larger", "--as", folder / "small", "-o", folder / "small2"),
    ):
        outcome = slimsfm("reduce", *arguments)
        assert outcome.code == 0, outcome.err
    small, again = (json.loads((folder / name / "map.json").read_text()) for name in ("small", "small2"))
    assert small["parent"]["path"] == "../map"
    assert again["parent"]["path"] == "../larger"
    assert small["parent"]["options"] == again["parent"]["options"]
    assert len(read_map(folder / "small2").point3D_ids) <= 150
    refused = slimsfm("add", folder / "small", folder / "new", "-o", folder / "none")
    assert refused.code == 2
    assert f"{folder / 'map'}, which it was made from" in refused.err
    assert not (folder / "none").exists()
    both = slimsfm("reduce", folder / "larger", "--as", folder / "small", "--seed", 1, "-o", folder / "none")
    assert both.code == 2
    full = slimsfm("reduce", folder / "larger", "--as", folder / "map", "-o", folder / "none")
    assert full.code == 2
    assert "does not say how it was reduced" in full.err


def test_photos_of_another_place_write_nothing(grown, tmp_path):
    folder, _, _ = grown
    (tmp_path / "photos").mkdir()
    Image.effect_noise((320, 240), 80).convert("RGB").save(tmp_path / "photos" / "x.png")
    outcome = slimsfm("add", folder / "map", tmp_path / "photos", "-o", tmp_path / "out")
    assert outcome.code == 2
    assert "none of 1 photos could be added" in outcome.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_forget_writes_only_with_an_output(grown, tmp_path):
    folder, _, _ = grown
    dry = slimsfm("forget", folder / "larger", "--max-images", 20, "--workers", 1)
    assert dry.code == 0, dry.err
    assert "nothing was written" in dry.out
    done = slimsfm("forget", folder / "larger", "--max-images", 20, "-o", tmp_path / "tidy", "--workers", 1)
    assert done.code == 0, done.err
    assert len(read_map(tmp_path / "tidy").images) == 20
