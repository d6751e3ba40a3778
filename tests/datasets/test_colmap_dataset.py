import os
import pickle
from dataclasses import replace

import numpy as np
import pytest

from databases import write_features
from scenes import exact_map, like_sift, with_matches
from slimsfm.datasets.base import map_object
from slimsfm.datasets.reconstructed import Colmap
from slimsfm.errors import ImageError, InputError, ModelError
from slimsfm.features.store import FeatureWriter
from slimsfm.mapping.map import check_map


@pytest.fixture
def truth():
    return like_sift(with_matches(exact_map(num_images=9, reach_deg=60.0)))


@pytest.fixture
def project(tmp_path, truth, write_image):
    """A COLMAP project called cup, with hloc's features next to it."""
    model = tmp_path / "cup" / "sparse" / "0"
    model.mkdir(parents=True)
    truth.model.write(model)
    for name in truth.images:
        write_image(tmp_path / "photos" / name, truth.camera(name).width, truth.camera(name).height)
    with FeatureWriter(tmp_path / "features.h5") as writer:
        for name in truth.images:
            writer.write(name, truth.features[name])
    return Colmap(path=model, images=tmp_path / "photos", features=tmp_path / "features.h5")


def assert_is_part_of(sequence, truth, names):
    assert sequence.names == tuple(names)
    for name, camera, pose in zip(names, sequence.cameras, sequence.cam_from_world, strict=True):
        assert np.array_equal(pose.matrix(), truth.images[name].cam_from_world().matrix())
        assert (camera.width, camera.height) == (640, 480)
        assert np.array_equal(camera.params, truth.camera(name).params)


def test_every_third_image_is_a_query_and_the_others_are_for_mapping(project, truth, making):
    made = project.load("cup", making)
    assert made.mapping.folder == made.query.folder == project.images
    queries = ["001.png", "004.png", "007.png"]
    assert_is_part_of(made.query, truth, queries)
    assert_is_part_of(made.mapping, truth, sorted(set(truth.images) - set(queries)))
    assert (made.name, made.unit, made.model) == ("cup", "unknown", None)
    assert made.truth is not None
    assert np.array_equal(made.box.corners, made.truth.box.corners)


def test_the_map_of_an_object_is_the_model_without_the_queries(project, making, tmp_path):
    made = project.load("cup", making)
    references = map_object(made, tmp_path)
    check_map(references)
    assert tuple(references.images) == made.mapping.names
    assert references.box is made.truth.box


def test_a_file_lists_the_queries(project, truth, making, tmp_path):
    listed = tmp_path / "queries.txt"
    listed.write_text("\n008.png\n002.png PINHOLE 640 480 500 500 320 240\n008.png\n")
    made = replace(project, queries=listed).load("cup", making)
    assert_is_part_of(made.query, truth, ["002.png", "008.png"])
    assert len(made.mapping.names) == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("002.png\n099.png\n", "lists '099.png', which has no pose in the model"),
        ("", "lists 0 of the 9 images"),
        ("".join(f"{k:03d}.png\n" for k in range(1, 9)), "lists 8 of the 9 images"),
        (None, "there is no such file"),
        (b"\xff\xfe\xff", "cannot be read"),
    ],
    ids=["stranger", "none", "too many", "missing", "no text"],
)
def test_a_wrong_list_is_named_in_the_error(project, making, tmp_path, text, message):
    listed = tmp_path / "queries.txt"
    if text is not None:
        listed.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message) as error:
        replace(project, queries=listed).load("cup", making)
    assert str(listed) in str(error.value)


@pytest.mark.parametrize("place", ["cup/sparse/0", "cup"])
def test_descriptors_come_from_a_database_in_the_project(project, truth, making, tmp_path, place):
    write_features(tmp_path / place / "database.db", truth)
    made = replace(project, features=None).load("cup", making)
    assert "descriptors from its database" in made.truth.info.origin


def test_without_any_descriptors_they_are_computed_from_the_images(rendered, rendered_map, making, tmp_path):
    model = tmp_path / "box" / "sparse"
    model.mkdir(parents=True)
    rendered_map.model.write(model)
    made = Colmap(path=model, images=rendered[1].mapping.folder).load("box", making)
    assert "descriptors from its images" in made.truth.info.origin
    assert made.truth.info.extractor == "sift"
    assert set(made.truth.images) == set(rendered_map.images)


def test_an_object_has_the_name_of_its_project(tmp_path, monkeypatch):
    for path, name in (("cup/sparse/0", "cup"), ("cup/sparse", "cup"), ("out/sfm", "sfm"), ("cup/0", "cup")):
        assert Colmap(path=tmp_path / path, images=tmp_path).names() == (name,)
    (tmp_path / "cup" / "sparse").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "cup" / "sparse")
    assert Colmap(path=tmp_path.__class__(os.curdir), images=tmp_path).names() == ("cup",)


def test_it_can_be_pickled(project):
    assert pickle.loads(pickle.dumps(project)) == project


def test_two_sources_of_descriptors_are_an_error(project, tmp_path):
    with pytest.raises(ValueError, match="give only one source"):
        replace(project, database=tmp_path / "database.db")
    with pytest.raises(ValueError, match="matches needs features"):
        Colmap(path=tmp_path, images=tmp_path, matches=tmp_path / "matches.h5")


DAMAGES = {
    "no points": ("cup/sparse/0/points3D.bin", None, ModelError, "missing"),
    "cut images": ("cup/sparse/0/images.bin", b"\1\0\0\0\0\0\0\0", ModelError, "damaged or cut short"),
    "no photo": ("photos/003.png", None, ImageError, "there is no such file"),
    "cut photo": ("photos/003.png", b"\x89PNG\r\n", ImageError, "cannot be read as an image"),
    "no features": ("features.h5", None, InputError, "no such"),
    "damaged features": ("features.h5", b"none", InputError, "HDF5"),
}


@pytest.mark.parametrize(("path", "content", "kind", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_wrong_file_is_named_in_the_error(project, making, damage, tmp_path, path, content, kind, message):
    damage(tmp_path / path, content)
    with pytest.raises(kind, match=message) as error:
        project.load("cup", making)
    assert str(tmp_path / path) in str(error.value)
    assert "\n" not in str(error.value)


def test_photos_that_differ_in_size_from_the_camera_are_an_error(project, making, write_image):
    write_image(project.images / "004.png", 320, 240)
    with pytest.raises(ImageError, match=r"004\.png has 320x240 pixels, but .* 640x480: pass the images"):
        project.load("cup", making)


def test_too_frequent_queries_and_unknown_names_are_errors(project, making):
    with pytest.raises(InputError, match="`query_every=1` leaves 0 references of 9 images"):
        replace(project, query_every=1).load("cup", making)
    with pytest.raises(InputError, match="has no object '0'; it has cup"):
        project.load("0", making)
