from inspect import unwrap
from typing import get_args

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from scenes import camera
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import camera_from_exif
from slimsfm.geometry import project
from slimsfm.localization.cameras import FocalLength, guess_camera, query_camera
from slimsfm.localization.map_cameras import scaled_camera
from slimsfm.mapping.camera_file import read_camera


def photo(path, size=(640, 480), focal_35mm=None):
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    Image.new("RGB", size).save(path, exif=exif)
    return path


def test_the_given_camera_follows_a_resized_image(exact, tmp_path):
    chosen = query_camera(exact, photo(tmp_path / "a.jpg", (320, 240)), camera())
    assert chosen.source == "given"
    assert (chosen.camera.width, chosen.camera.height) == (320, 240)
    assert np.allclose(chosen.camera.params[:4], camera().params[:4] / 2)
    assert np.array_equal(chosen.camera.params[4:], camera().params[4:])


@pytest.mark.parametrize("focal", get_args(FocalLength))
def test_a_given_camera_of_another_shape_is_refused(exact, focal, tmp_path):
    path = photo(tmp_path / "a.jpg", (480, 640))
    with pytest.raises(ImageError, match=r"a\.jpg: has 480x640 pixels, but the given camera 640x480"):
        query_camera(exact, path, camera(), focal)


def test_only_a_focal_length_that_must_be_known_is_asked_for(exact, two_cameras, tmp_path):
    for map_, path, cameras in (
        (exact, photo(tmp_path / "upright.png", (480, 640)), "the map's camera"),
        (two_cameras, photo(tmp_path / "plain.png"), "one of the map's 2 cameras"),
    ):
        with pytest.raises(ImageError, match=f"{path.name}.*{cameras}.*camera=FILE.*focal='unknown'"):
            query_camera(map_, path, None, "known")
        for focal in ("auto", "approximate", "unknown"):
            chosen = query_camera(map_, path, None, focal)
            assert chosen.source == "unknown"
            assert str(chosen.camera) == str(guess_camera(chosen.camera.width, chosen.camera.height))
            assert not chosen.camera.has_prior_focal_length


def test_an_unknown_value_of_focal_is_refused(exact, tmp_path):
    values = "auto, known, approximate, unknown"
    with pytest.raises(ValueError, match=f"focal must be one of {values}, got 'guessed'"):
        unwrap(query_camera)(exact, photo(tmp_path / "a.png"), None, "guessed")


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1, 1)], ids=str)
def test_a_guess_equals_that_of_colmap(size, tmp_path):
    guess = guess_camera(*size)
    theirs = camera_from_exif(photo(tmp_path / "a.png", size))
    assert guess.model_name == "SIMPLE_RADIAL"
    assert guess.focal_length == 1.2 * max(size)
    assert np.array_equal(guess.params, theirs.params)
    assert (guess.width, guess.height) == (theirs.width, theirs.height) == size


@pytest.mark.parametrize(("size", "name"), [((0, 480), "width"), ((640, -1), "height")], ids=str)
def test_an_image_without_pixels_gets_no_guess(size, name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        guess_camera(*size)


@pytest.mark.parametrize("size", [(320, 240), (960, 720), (641, 481), (321, 240), (213, 160)], ids=str)
def test_a_scaled_camera_sees_the_same_scene_scaled(size):
    points = np.random.default_rng(0).uniform((-1, -1, 4), (1, 1, 6), (50, 3))
    scaled = scaled_camera(camera(), *size)
    assert (scaled.width, scaled.height) == size
    expected = project(points, pycolmap.Rigid3d(), camera()) * (size[0] / 640, size[1] / 480)
    assert np.allclose(project(points, pycolmap.Rigid3d(), scaled), expected, atol=1e-9)


@pytest.mark.parametrize("size", [(480, 640), (640, 400), (1, 1000)], ids=str)
def test_another_aspect_ratio_cannot_be_scaled(size):
    assert scaled_camera(camera(), *size) is None


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_a_camera_file_of_colmap_is_read(model, tmp_path):
    written = camera(model)
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(written)
    reconstruction.write_text(tmp_path)
    read = read_camera(tmp_path / "cameras.txt")
    assert np.array_equal(read.params, written.params)
    assert (read.model_name, read.width, read.height, read.camera_id) == (model, 640, 480, 1)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# only a comment\n",
        "1 PINHOLE 640 480 500 500 320\n",
        "1 PINHOLE 640 480 500 500 320 240 1\n",
        "1 PINHOLE 640 480 500 500 320 high\n",
        "1 PINHOLE 640 480 500 nan 320 240\n",
        "1 PINHOLE 640 480 -500 500 320 240\n",
        "1 PINHOLE 0 480 500 500 320 240\n",
        "1 PINHOLE -640 480 500 500 320 240\n",
        "-1 PINHOLE 640 480 500 500 320 240\n",
        "1 PINWHEEL 640 480 500 500 320 240\n",
        "1 EQUIRECTANGULAR 640 320 640 320\n",
        "1 PINHOLE 640\n",
        "1 OPENCV 1024 768 700 700 512 384 1e9 1e9 1e9 1e9\n",
        "1 PINHOLE 640 480 1e300 500 320 240\n",
        "1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n",
    ],
)
def test_a_bad_camera_file_is_named(text, tmp_path):
    path = tmp_path / "camera.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"camera\.txt: (should hold one line|the camera is impossible)"):
        read_camera(path)


def test_an_unreadable_camera_file_is_named(tmp_path):
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("missing.txt", "bytes.txt", "."):
        with pytest.raises(InputError, match="not a readable camera file"):
            read_camera(tmp_path / name)
