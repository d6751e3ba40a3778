from pathlib import Path

import numpy as np
import pytest
from PIL.TiffImagePlugin import IFDRational

from exif_photos import save_photo
from slimsfm.errors import InputError
from slimsfm.exif import Exif, read_exif
from slimsfm.mapping.extraction import guess_cameras

WIDE, TALL = np.zeros((40, 60, 3), np.uint8), np.zeros((60, 40, 3), np.uint8)


@pytest.fixture
def exifs(tmp_path: Path) -> dict[str, Exif]:
    """Two photos of 28 mm, one of 50 mm, and two of 28 mm that are held sideways, one without saying so."""
    photos = {
        "a": (WIDE, 28, 1),
        "b": (WIDE, 28, 3),
        "c": (WIDE, 50, 1),
        "d": (TALL, 28, 6),
        "e": (TALL, 28, 1),
    }
    return {
        name: read_exif(save_photo(tmp_path / f"{name}.jpg", picture, tag, FocalLengthIn35mmFilm=focal))
        for name, (picture, focal, tag) in photos.items()
    }


def groups(cameras):
    assert all(0 < camera.camera_id <= len(cameras) for camera in cameras.values())
    for camera in cameras.values():
        same = [other for other in cameras.values() if other.camera_id == camera.camera_id]
        assert all(repr(other) == repr(camera) for other in same)
    return [camera.camera_id for camera in cameras.values()]


def joined(guessed):
    """Ids of the cameras after the pictures that are held otherwise are turned."""
    return groups({**guessed.by_name, **guessed.turned})


def test_auto_shares_a_camera_if_size_and_focal_length_agree(exifs):
    guessed = guess_cameras(exifs, "auto")
    assert groups(guessed.by_name) == [1, 1, 3, 2, 2]
    assert joined(guessed) == [1, 1, 3, 1, 1]
    assert list(guessed.turned) == ["d", "e"]
    assert (guessed.by_name["d"].width, guessed.by_name["d"].height) == (40, 60)
    assert (guessed.turned["d"].width, guessed.turned["d"].height) == (60, 40)


def test_only_pictures_whose_pixels_are_held_otherwise_are_turned(exifs):
    assert list(guess_cameras(exifs, "auto", "stored").turned) == ["e"]
    assert list(guess_cameras({name: exifs[name] for name in "ade"}, "auto").turned) == ["a"]


def test_shared_is_one_camera_in_spite_of_zoom_however_it_was_held(exifs):
    guessed = guess_cameras(exifs, "shared")
    assert joined(guessed) == [1] * 5
    assert guessed.turned["d"].focal_length == exifs["a"].focal_px


def test_per_image_gives_each_image_its_camera(exifs):
    guessed = guess_cameras(exifs, "per-image")
    assert groups(guessed.by_name) == [1, 2, 3, 4, 5]
    assert not guessed.turned


def test_images_of_two_sizes_cannot_share_a_camera(exifs, tmp_path):
    other = {"f.jpg": read_exif(save_photo(tmp_path / "f.jpg", WIDE[:30])), "a.jpg": exifs["a"]}
    with pytest.raises(InputError, match=r"f\.jpg has 60x30 pixels, a\.jpg 60x40.*camera='auto'"):
        guess_cameras(other, "shared")


@pytest.mark.parametrize(
    "tags", [{"Model": "X2"}, {"Make": "Other"}, {"FocalLength": IFDRational(90, 10)}], ids=repr
)
def test_auto_separates_devices_and_lenses_of_unknown_focal_length(tmp_path, tags):
    known = {"Make": "Some", "Model": "X1", "FocalLength": IFDRational(40, 10)}
    photos = {"a": known, "b": known, "c": known | tags}
    exifs = {
        name: read_exif(save_photo(tmp_path / f"{name}.jpg", WIDE, **one)) for name, one in photos.items()
    }
    assert not any(exif.focal_px for exif in exifs.values())
    assert groups(guess_cameras(exifs, "auto").by_name) == [1, 1, 2]
