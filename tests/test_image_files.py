import os

import numpy as np
import pytest
from PIL import Image

from slimsfm.errors import ImageError, InputError
from slimsfm.exif import camera_from_exif
from slimsfm.image_files import can_read_heic, find_images, is_image, list_images
from slimsfm.photos import read_image


def picture(width=24, height=16):
    """A smooth picture, which no format distorts much."""
    y, x = np.mgrid[:height, :width]
    return np.stack([8 * x, 12 * y, 4 * x + 4 * y], axis=-1).astype(np.uint8)


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


SUFFIXES = [
    *("jpg", "jpeg", "jpe", "jfif", "png", "apng", "tif", "tiff", "webp", "avif", "jp2", "j2k", "jpx", "bmp"),
    *("dib", "gif", "ppm", "pnm", "tga", "pcx", "sgi", "rgb", "qoi"),
]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_of_the_table_is_listed_and_read(tmp_path, suffix):
    for name in (f"a.{suffix}", f"b.{suffix.upper()}"):
        Image.fromarray(picture()).save(tmp_path / name)
        read = read_image(tmp_path / name)
        assert read.shape == (16, 24, 3)
        assert np.abs(read.astype(int) - picture()).mean() < 12
        camera = camera_from_exif(tmp_path / name)
        assert (camera.width, camera.height) == (24, 16)
        assert camera.focal_length == pytest.approx(1.2 * 24)
    assert find_images(tmp_path).names == (f"a.{suffix}", f"b.{suffix.upper()}")
    assert find_images(tmp_path).notes == ()


def test_images_are_listed_in_order_with_subfolders_and_without_hidden_ones(tmp_path):
    touch(
        tmp_path, "b.JPG", "a 1.png", "sub/c.jpeg", "sub/deep/ä.webp", ".hidden.png", ".trash/d.png", "e.txt"
    )
    (tmp_path / "folder.png").mkdir()
    assert list_images(tmp_path) == ["a 1.png", "b.JPG", "sub/c.jpeg", "sub/deep/ä.webp"]
    assert list_images(str(tmp_path)) == list_images(tmp_path)


def test_folder_inside_a_hidden_one_is_not_hidden(tmp_path):
    touch(tmp_path, ".cache/photos/a.png")
    assert list_images(tmp_path / ".cache" / "photos") == ["a.png"]


def test_folder_without_images_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="contains no image"):
        list_images(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        list_images(tmp_path / "missing")


def test_what_is_skipped_is_counted_by_kind_with_names(tmp_path, caplog):
    touch(
        tmp_path, "a.jpg", "c.DNG", "sub/b.nef", "v.mov", "w.mp4", "x.jxl", ".d.mp4", "notes.txt", "no suffix"
    )
    found = find_images(tmp_path)
    assert found.names == ("a.jpg",)
    assert sorted(found.notes) == [
        "1 JPEG XL file skipped: x.jxl",
        "2 other files skipped (.txt, no suffix)",
        "2 raw files skipped: c.DNG, sub/b.nef",
        "2 video files skipped: v.mov, w.mp4",
    ]
    assert list_images(tmp_path) == ["a.jpg"]
    assert [record.getMessage() for record in caplog.records] == [f"{tmp_path}: {one}" for one in found.notes]


def test_a_folder_of_unsupported_photos_names_them(tmp_path):
    touch(tmp_path, "a.dng", "b.mov")
    with pytest.raises(
        InputError, match=r"no image.*; 1 raw file skipped: a\.dng; 1 video file skipped: b\.mov"
    ):
        find_images(tmp_path)


def test_heic_photos_are_read_or_the_package_for_them_is_named(tmp_path):
    if can_read_heic():
        import pillow_heif

        pillow_heif.register_heif_opener()
        Image.fromarray(picture(64, 64)).save(tmp_path / "a.heic")
        assert read_image(tmp_path / "a.heic").shape == (64, 64, 3)
        assert find_images(tmp_path).names == ("a.heic",)
        return
    (tmp_path / "a.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(InputError, match=r"1 HEIC file skipped .*pip install 'slimsfm\[heic\]'\): a\.HEIC"):
        find_images(tmp_path)
    (tmp_path / "a.HEIC").rename(tmp_path / "a.jpg")  # as some programs name them
    with pytest.raises(ImageError, match=r"a\.jpg: HEIC.*pip install 'slimsfm\[heic\]'"):
        read_image(tmp_path / "a.jpg")


def test_links_are_followed_and_what_they_repeat_is_listed_once(tmp_path):
    photos, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    touch(photos, "b.png", "sub/c.png")
    touch(elsewhere, "d.png", "deep/e.png", "linked.png")
    (photos / "a.png").symlink_to(photos / "b.png")
    (photos / "broken.png").symlink_to(tmp_path / "missing.png")
    (photos / "file.png").symlink_to(elsewhere / "linked.png")
    (photos / "folder").symlink_to(elsewhere)
    (photos / "again").symlink_to(photos / "sub")
    (photos / "sub" / "circle").symlink_to(photos)
    (elsewhere / "deep" / "up").symlink_to(elsewhere)
    found = find_images(photos)
    assert found.names == ("b.png", "folder/d.png", "folder/deep/e.png", "folder/linked.png", "sub/c.png")
    assert found.notes == (
        "1 link to nothing skipped: broken.png",
        "5 links skipped to what is listed already: a.png, again, file.png, folder/deep/up, sub/circle",
    )


def test_a_folder_can_be_left_out(tmp_path):
    touch(tmp_path, "a.png", "masks/a.png", "masks/sub/b.png")
    assert find_images(tmp_path, leave_out=tmp_path / "masks").names == ("a.png",)


@pytest.mark.parametrize("letter", ["\n", "\r", "\t", "\x7f", "\x85", "\u2028", "\udcff"])
def test_names_that_lists_of_names_cannot_hold_are_refused(tmp_path, letter):
    touch(tmp_path, "b.png")
    (tmp_path / f"a{letter}b.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"the name 'a\\.+b\.png' has a line break or .*rename the image"):
        find_images(tmp_path)


def test_names_may_have_spaces_quotes_and_letters_of_any_language(tmp_path):
    names = ["#1.png", "a 'quoted' \"name\".png", "a, b; c.png", "ünï 写真.png"]
    touch(tmp_path, *names)
    assert list_images(tmp_path) == sorted(names)


def test_names_that_only_hloc_does_not_tell_apart_are_accepted(tmp_path):
    touch(tmp_path, "a/b.png", "a-b.png")
    assert list_images(tmp_path) == ["a-b.png", "a/b.png"]


def test_an_image_is_told_by_its_name(tmp_path):
    names = ("a.png", "a.JPG", ".a.png", "a.txt", "a")
    assert [is_image(tmp_path / name) for name in names] == [True, True, False, False, False]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may read every folder")
def test_a_folder_that_may_not_be_read_is_named(tmp_path):
    touch(tmp_path, "a.png", "closed/b.png")
    (tmp_path / "closed").chmod(0)
    try:
        assert find_images(tmp_path).notes == ("1 folder skipped that may not be read: closed",)
    finally:
        (tmp_path / "closed").chmod(0o700)
