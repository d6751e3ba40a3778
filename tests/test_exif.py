"""EXIF is a first guess: focal lengths that no lens has are ignored, and said."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL.TiffImagePlugin import IFDRational

from exif_photos import STORED, save_photo
from slimsfm.devices import Device
from slimsfm.exif import camera_from_exif, ignored_values, read_exif, read_orientation

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
ABSURD = [IFDRational(*one) for one in ((0, 1), (0, 0), (4, 0), (1, 10**6), (10**6, 1))]
PHONE = {"Make": "Apple", "Model": "iPhone 6"}  # its sensor is in COLMAP's list


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("tag", STORED)
def test_the_focal_length_is_from_exif_and_the_size_is_that_of_the_pixels(tmp_path, tag, suffix):
    path = save_photo(tmp_path / f"a.{suffix}", PICTURE, tag, FocalLengthIn35mmFilm=28)
    assert read_orientation(path) == read_exif(path).orientation == tag
    film_diagonal, diagonal = np.hypot(36, 24), np.hypot(60, 40)
    stored = STORED[tag](PICTURE).shape[1::-1]
    for camera, size in (
        (camera_from_exif(path), (60, 40)),
        (camera_from_exif(path, "stored"), stored),
    ):
        assert camera.has_prior_focal_length
        assert camera.focal_length == pytest.approx(28 / film_diagonal * diagonal, rel=1e-4)
        assert (camera.width, camera.height) == size
        assert camera.params[1:].tolist() == [size[0] / 2, size[1] / 2, 0]


@pytest.mark.parametrize("tag", STORED)
def test_tiff_files_have_the_size_of_their_pixels(tmp_path, tag):
    path = save_photo(tmp_path / "a.tif", PICTURE, tag)  # which Pillow turns by itself
    assert read_orientation(path) == tag
    assert read_exif(path).size("upright") == (60, 40)
    assert read_exif(path).size("stored") == STORED[tag](PICTURE).shape[1::-1]


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_without_exif_the_focal_length_is_guessed_and_marked_as_such(tmp_path, suffix):
    exif = read_exif(save_photo(tmp_path / f"a.{suffix}", PICTURE))
    camera = exif.camera("upright")
    assert not camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(1.2 * 60)
    assert (exif.ignored, exif.device) == ("", Device())


@pytest.mark.parametrize(
    "tags",
    [
        {"FocalLengthIn35mmFilm": 65535},
        {"FocalLengthIn35mmFilm": 10_000},
        {"FocalLengthIn35mmFilm": 1},
        {"FocalLengthIn35mmFilm": 0},
        {"FocalLengthIn35mmFilm": 65535, "FocalLength": IFDRational(42, 10), **PHONE},
        *({"FocalLength": value, **PHONE} for value in ABSURD),
        *(
            {"FocalLength": IFDRational(42, 10), "FocalPlaneResolutionUnit": 2}
            | dict.fromkeys(("FocalPlaneXResolution", "FocalPlaneYResolution"), value)
            for value in ABSURD
        ),
    ],
    ids=repr,
)
def test_an_impossible_focal_length_is_ignored_and_named(tmp_path: Path, tags: dict) -> None:
    exif = read_exif(save_photo(tmp_path / "a.jpg", PICTURE, 6, **tags))
    camera = exif.camera("upright")
    assert not camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(1.2 * 60)
    (wrong,) = [tag for tag in tags if tag.startswith("Focal")][:1]
    assert wrong in exif.ignored
    (note,) = ignored_values({"b.jpg": exif, "a.jpg": exif})
    assert "2 photos" in note
    assert note.endswith(": a.jpg, b.jpg")


@pytest.mark.parametrize("focal_35mm", [8, 14, 28, 50, 200, 400])
def test_the_focal_lengths_of_lenses_are_used(tmp_path, focal_35mm):
    exif = read_exif(save_photo(tmp_path / "a.jpg", PICTURE, FocalLengthIn35mmFilm=focal_35mm))
    assert exif.focal_px == pytest.approx(focal_35mm / np.hypot(36, 24) * np.hypot(60, 40), rel=1e-3)
    assert not exif.ignored


def test_the_focal_length_for_film_counts_in_formats_that_colmap_does_not_read(tmp_path):
    path = save_photo(tmp_path / "a.avif", PICTURE, Make="Acme", FocalLengthIn35mmFilm=28)
    with pytest.raises((RuntimeError, ValueError)):
        pycolmap.infer_camera_from_image(path)
    assert read_exif(path).focal_px == pytest.approx(28 / np.hypot(36, 24) * np.hypot(60, 40))


@pytest.mark.parametrize("resolution", [200, 500, 2000])
def test_the_resolution_of_the_sensor_gives_the_focal_length(tmp_path, resolution):
    pixels, lens = IFDRational(resolution, 1), IFDRational(42, 10)
    tags = {"FocalPlaneXResolution": pixels, "FocalPlaneYResolution": pixels, "FocalPlaneResolutionUnit": 2}
    exif = read_exif(save_photo(tmp_path / "a.jpg", PICTURE, FocalLength=lens, **tags))
    assert exif.focal_px == pytest.approx(4.2 / 25.4 * resolution, rel=1e-4)
