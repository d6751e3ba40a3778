import logging
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.datasets.base import LoadOptions, map_object
from slimsfm.datasets.reconstructed import Images
from slimsfm.errors import InputError


@pytest.fixture(scope="module")
def reconstructed(photos, tmp_path_factory):
    """A folder of photos, where its reconstruction is kept, and what came of it."""
    making = LoadOptions(folder=tmp_path_factory.mktemp("made"))
    dataset = Images(path=photos, query_every=4)
    return dataset, making, dataset.load("box", making)


def test_all_photos_are_reconstructed_and_every_nth_is_a_query(reconstructed):
    dataset, _, made = reconstructed
    assert made.query.names == ("0.png", "4.png")
    assert made.mapping.names == ("1.png", "2.png", "3.png", "5.png", "6.png", "7.png")
    assert made.mapping.folder == made.query.folder == dataset.path
    assert (made.name, made.unit, made.model) == ("box", "unknown", None)
    for sequence in (made.mapping, made.query):
        for name, camera, pose in zip(sequence.names, sequence.cameras, sequence.cam_from_world, strict=True):
            assert np.array_equal(pose.matrix(), made.truth.images[name].cam_from_world().matrix())
            assert np.array_equal(camera.params, made.truth.camera(name).params)


def test_the_map_of_the_object_has_no_trace_of_the_queries(reconstructed, tmp_path):
    made = reconstructed[2]
    references = map_object(made, tmp_path)
    assert tuple(references.images) == made.mapping.names
    assert set(references.features) == set(made.mapping.names)


def test_the_reconstruction_is_stored_and_reused(reconstructed):
    dataset, making, made = reconstructed
    kept = making.folder / "pseudo-ground-truth"
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("*")}
    again = replace(dataset, query_every=2).load("box", making)
    assert again.truth.fingerprint == made.truth.fingerprint
    assert again.query.names == ("0.png", "2.png", "4.png", "6.png")
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*")} == before


def test_unregistered_photos_are_logged_and_left_out(reconstructed, tmp_path, caplog):
    dataset, making, made = reconstructed
    more = shutil.copytree(dataset.path, tmp_path / "box")
    shutil.copy(more / "0.png", more / "8.png")
    with caplog.at_level(logging.WARNING, logger="slimsfm"):
        again = replace(dataset, path=more).load("box", making)
    assert [record.getMessage() for record in caplog.records] == [
        f"{more}: not registered and so left out: 8.png"
    ]
    assert again.mapping.names == made.mapping.names


def test_a_reconstruction_of_other_photos_is_an_error(reconstructed, tmp_path):
    dataset, making, _ = reconstructed
    fewer = shutil.copytree(dataset.path, tmp_path / "box")
    (fewer / "3.png").unlink()
    with pytest.raises(InputError, match=r"has other images \(3\.png is not in .*choose another output"):
        replace(dataset, path=fewer).load("box", making)


def test_each_folder_of_photos_is_an_object(photos, tmp_path, making):
    for name in ("mug", "cup"):
        shutil.copytree(photos, tmp_path / "all" / name / "morning")
    (tmp_path / "all" / "empty").mkdir()
    dataset = Images(path=tmp_path / "all", query_every=8)
    assert dataset.names() == ("cup", "mug")
    with pytest.raises(InputError, match="has no object 'empty'; it has cup, mug"):
        dataset.load("empty", making)


def test_only_the_requested_folder_is_reconstructed(reconstructed, photos, tmp_path):
    _, making, made = reconstructed
    shutil.copytree(photos, tmp_path / "all" / "mug")
    again = Images(path=tmp_path / "all", query_every=4).load("mug", making)
    assert again.name == "mug"
    assert again.mapping.folder == tmp_path / "all" / "mug"
    assert again.mapping.names == made.mapping.names


def test_the_current_folder_has_its_own_name(photos, monkeypatch):
    monkeypatch.chdir(photos)
    assert Images(path=photos.__class__(".")).names() == ("box",)


@pytest.mark.parametrize("every", [0, 1])
def test_too_frequent_queries_are_an_error_before_any_work(photos, making, every):
    with pytest.raises(InputError, match=f"`query_every={every}` leaves"):
        Images(path=photos, query_every=every).load("box", making)
    assert not making.folder.exists()


def test_a_folder_without_photos_or_no_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="contains no image"):
        Images(path=tmp_path).names()
    with pytest.raises(InputError, match="missing: no such folder of images"):
        Images(path=tmp_path / "missing").names()


def test_a_damaged_photo_is_named_and_left_out(photos, making, tmp_path, caplog):
    damaged = shutil.copytree(photos, tmp_path / "box")
    (damaged / "2.png").write_bytes(b"no image")
    made = Images(path=damaged).load("box", making)
    assert "2.png: skipped: not a readable image" in caplog.text
    assert "2.png" not in {*made.mapping.names, *made.query.names}


def test_it_can_be_pickled(tmp_path):
    dataset = Images(path=tmp_path, query_every=5)
    assert pickle.loads(pickle.dumps(dataset)) == dataset
