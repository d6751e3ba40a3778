from inspect import unwrap

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from scenes import camera
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import camera_from_exif
from slimsfm.geometry import project
from slimsfm.localization.cameras import guess_camera, query_camera, read_camera, scaled_camera


def photo(path, size=(640, 480), focal_35mm=None):
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    Image.new("RGB", size).save(path, exif=exif)
    return path


@pytest.fixture
def px_per_mm(tmp_path):
    path = photo(tmp_path / "probe.jpg", focal_35mm=35)
    seen = pycolmap.infer_camera_from_image(path)
    assert seen.has_prior_focal_length
    return seen.focal_length / 35


def test_the_given_camera_comes_first(exact, tmp_path):
    path = photo(tmp_path / "a.jpg", focal_35mm=80)
    given = camera("SIMPLE_RADIAL")
    assert query_camera(exact, path, given).model_name == "SIMPLE_RADIAL"


def test_the_given_camera_follows_a_resized_image(exact, tmp_path):
    chosen = query_camera(exact, photo(tmp_path / "a.jpg", (320, 240)), camera())
    assert (chosen.width, chosen.height) == (320, 240)
    assert np.allclose(chosen.params[:4], camera().params[:4] / 2)
    assert np.array_equal(chosen.params[4:], camera().params[4:])


def test_a_given_camera_of_another_shape_is_refused(exact, tmp_path):
    path = photo(tmp_path / "a.jpg", (480, 640))
    with pytest.raises(ImageError, match=r"a\.jpg: has 480x640 pixels, but the given camera 640x480"):
        query_camera(exact, path, camera())


def test_the_camera_of_the_map_comes_next(exact, tmp_path, px_per_mm):
    without_exif = photo(tmp_path / "a.png")
    assert np.array_equal(query_camera(exact, without_exif, None).params, camera().params)
    same = photo(tmp_path / "b.jpg", focal_35mm=round(502.5 / px_per_mm))
    assert np.array_equal(query_camera(exact, same, None).params, camera().params)


def test_exif_of_another_focal_length_means_another_camera(exact, tmp_path, px_per_mm):
    chosen = query_camera(exact, photo(tmp_path / "a.jpg", focal_35mm=80), None)
    assert chosen.model_name == "SIMPLE_RADIAL"
    assert chosen.focal_length == pytest.approx(80 * px_per_mm)
    assert (chosen.width, chosen.height) == (640, 480)


def test_exif_is_used_if_the_map_has_no_camera_for_the_image(exact, two_cameras, tmp_path):
    upright = photo(tmp_path / "a.jpg", (480, 640), focal_35mm=35)
    assert query_camera(exact, upright, None).has_prior_focal_length
    plain = photo(tmp_path / "b.jpg", focal_35mm=35)
    assert query_camera(two_cameras, plain, None).has_prior_focal_length


def test_without_any_of_them_the_error_asks_for_a_camera(exact, two_cameras, tmp_path):
    for map_, path in (
        (exact, photo(tmp_path / "upright.png", (480, 640))),
        (two_cameras, photo(tmp_path / "plain.png")),
    ):
        with pytest.raises(ImageError, match=f"{path.name}.*camera=FILE.*focal='unknown'"):
            query_camera(map_, path, None)


@pytest.mark.parametrize("focal", ["approximate", "unknown"])
def test_an_image_whose_focal_length_need_not_be_known_gets_a_guess(focal, exact, two_cameras, tmp_path):
    for map_, path, size in (
        (exact, photo(tmp_path / "upright.png", (480, 640)), (480, 640)),
        (two_cameras, photo(tmp_path / "plain.png"), (640, 480)),
    ):
        chosen = query_camera(map_, path, None, focal)
        assert str(chosen) == str(guess_camera(*size))
        assert not chosen.has_prior_focal_length


@pytest.mark.parametrize("focal", ["approximate", "unknown"])
def test_known_cameras_come_before_a_guess(focal, exact, two_cameras, tmp_path, px_per_mm):
    without_exif = photo(tmp_path / "a.png")
    assert np.array_equal(query_camera(exact, without_exif, None, focal).params, camera().params)
    assert query_camera(exact, without_exif, camera("SIMPLE_RADIAL"), focal).model_name == "SIMPLE_RADIAL"
    from_exif = query_camera(two_cameras, photo(tmp_path / "b.jpg", focal_35mm=80), None, focal)
    assert from_exif.focal_length == pytest.approx(80 * px_per_mm)
    with pytest.raises(ImageError, match="but the given camera 640x480"):
        query_camera(exact, photo(tmp_path / "c.png", (480, 640)), camera(), focal)


def test_an_unknown_value_of_focal_is_refused(exact, tmp_path):
    with pytest.raises(ValueError, match="focal must be one of known, approximate, unknown, got 'guessed'"):
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
        "1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n",
    ],
)
def test_a_bad_camera_file_is_named(text, tmp_path):
    path = tmp_path / "camera.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"camera\.txt: should hold one line"):
        read_camera(path)


def test_an_unreadable_camera_file_is_named(tmp_path):
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("missing.txt", "bytes.txt", "."):
        with pytest.raises(InputError, match="not a readable camera file"):
            read_camera(tmp_path / name)


@pytest.mark.parametrize("focal_35mm", [1, 5000, 65535])
def test_an_impossible_focal_length_is_no_evidence_of_another_camera(
    exact, two_cameras, tmp_path, focal_35mm
):
    path = photo(tmp_path / "a.jpg", focal_35mm=focal_35mm)
    assert np.array_equal(query_camera(exact, path, None).params, camera().params)
    with pytest.raises(
        ImageError, match=rf"a\.jpg: .*FocalLengthIn35mmFilm {focal_35mm}, which is impossible"
    ):
        query_camera(two_cameras, path, None)
    guessed = query_camera(two_cameras, path, None, "unknown")
    assert guessed.focal_length == guess_camera(640, 480).focal_length
