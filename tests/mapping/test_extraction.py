import numpy as np
import pytest
from PIL import ExifTags, Image

from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.extraction import guess_cameras


@pytest.fixture
def folder(tmp_path):
    """Two photos of 28 mm, one of 50 mm and an upright one of 28 mm."""
    for name, focal, orientation in (("a", 28, 1), ("b", 28, 3), ("c", 50, 1), ("d", 28, 6)):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
        Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(tmp_path / f"{name}.jpg", exif=exif)
    return tmp_path


def groups(cameras):
    assert all(0 < camera.camera_id <= len(cameras) for camera in cameras.values())
    for camera in cameras.values():
        same = [other for other in cameras.values() if other.camera_id == camera.camera_id]
        assert all(repr(other) == repr(camera) for other in same)
    return [camera.camera_id for camera in cameras.values()]


def test_auto_shares_a_camera_if_size_and_focal_length_agree(folder):
    cameras = guess_cameras(folder, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"], "auto")
    assert groups(cameras) == [1, 1, 2, 3]
    assert (cameras["d.jpg"].width, cameras["d.jpg"].height) == (40, 60)


def test_shared_is_one_camera_in_spite_of_zoom(folder):
    assert groups(guess_cameras(folder, ["a.jpg", "b.jpg", "c.jpg"], "shared")) == [1, 1, 1]


def test_per_image_gives_each_image_its_camera(folder):
    assert groups(guess_cameras(folder, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"], "per-image")) == [1, 2, 3, 4]


def test_images_of_two_sizes_cannot_share_a_camera(folder):
    with pytest.raises(InputError, match=r"a\.jpg has 60x40 pixels, d\.jpg 40x60.*camera='auto'"):
        guess_cameras(folder, ["a.jpg", "d.jpg"], "shared")


def test_an_unreadable_image_is_named(folder):
    (folder / "e.jpg").write_text("hello")
    with pytest.raises(ImageError, match=r"e\.jpg"):
        guess_cameras(folder, ["a.jpg", "e.jpg"], "auto")
