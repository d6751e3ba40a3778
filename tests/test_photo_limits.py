"""Sizes of pictures are checked before their pixels are decoded; damaged pictures are read or refused."""

import logging
import zlib
from contextlib import suppress
from threading import Thread

import cv2
import numpy as np
import pytest
from PIL import Image

from mutations import mutations
from slimsfm.datasets.reading import image_size
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import read_device, read_exif, read_orientation
from slimsfm.limits import Limits, use_limits
from slimsfm.mapping.io import PhotoFile, write_photos
from slimsfm.photos import read_image, read_mask, read_photo

FORMATS = ["jpg", "png", "tif", "webp", "gif", "bmp", "ppm", "tga", "jp2", "pcx", "dds"]
READERS = [read_image, read_photo, read_mask, read_exif, read_device, read_orientation, image_size]


@pytest.fixture(params=FORMATS)
def picture(request, tmp_path):
    """A picture of 200 x 100 pixels, of any format."""
    path = tmp_path / f"a.{request.param}"
    pixels = np.random.default_rng(0).integers(0, 255, (100, 200, 3), np.uint8)
    Image.fromarray(cv2.GaussianBlur(pixels, (0, 0), 2)).save(path)
    return path


def test_every_reader_refuses_what_is_too_large(picture):
    for read in READERS:
        with use_limits(Limits(max_megapixels=0.02)):
            read(picture)
        with (
            use_limits(Limits(max_megapixels=0.019)),
            pytest.raises(ImageError, match=r"a\.\w+: has 0\.02 megapixels, more than the limit of 0\.019"),
        ):
            read(picture)


def test_a_damaged_picture_is_read_or_refused_by_name(picture, caplog):
    caplog.set_level(logging.CRITICAL)
    whole = picture.read_bytes()
    for name, damaged in mutations(whole, seed=6, count=24):
        picture.write_bytes(damaged)
        with use_limits(Limits(max_megapixels=1.0)), suppress(ImageError):
            assert read_image(picture).ndim == 3, name


@pytest.mark.parametrize("claimed", [13_000, 30_000, 2**31 - 1])
def test_a_picture_that_claims_to_be_huge_is_refused_at_once(tmp_path, claimed):
    path = tmp_path / "a.png"
    Image.new("L", (64, 64)).save(path)
    whole = bytearray(path.read_bytes())
    whole[16:24] = 2 * claimed.to_bytes(4, "big")
    whole[29:33] = zlib.crc32(whole[12:29]).to_bytes(4, "big")
    path.write_bytes(whole)
    with pytest.raises(ImageError, match=r"a\.png: has .* megapixels, more than the limit of 120; shrink it"):
        read_image(path)


def test_pictures_of_16_bits_and_of_many_rows_are_whole(tmp_path):
    values = np.arange(600 * 7 * 3, dtype=np.uint16).reshape(600, 7, 3)
    cv2.imwrite(str(tmp_path / "deep.png"), values)
    assert np.array_equal(read_image(tmp_path / "deep.png"), values[..., ::-1] // 2**6)
    colors = np.random.default_rng(0).integers(0, 255, (600, 7, 4), np.uint8)
    Image.fromarray(colors, "RGBA").save(tmp_path / "clear.png")
    photo = read_photo(tmp_path / "clear.png")
    assert np.array_equal(photo.image, colors[..., :3])
    assert np.array_equal(photo.alpha > 0, colors[..., 3] > 0)


def test_the_limit_of_pillow_is_the_users_again_after_reading_on_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    Image.new("RGB", (100, 100)).save(tmp_path / "a.png")
    threads = [Thread(target=read_image, args=(tmp_path / "a.png",)) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_photos_of_maps_are_bounded_and_damaged_ones_named(tmp_path):
    photo = np.random.default_rng(0).integers(0, 255, (100, 200, 3), np.uint8)
    write_photos(tmp_path / "photos.h5", {"a.jpg": photo, "b/c.jpg": photo[:50]})
    assert {name: one.shape for name, one in PhotoFile(tmp_path / "photos.h5").items()} == {
        "a.jpg": (100, 200, 3),
        "b/c.jpg": (50, 200, 3),
    }
    with (
        use_limits(Limits(max_megapixels=0.019)),
        pytest.raises(ImageError, match="the photo of"),
    ):
        PhotoFile(tmp_path / "photos.h5")["a.jpg"]
    whole = (tmp_path / "photos.h5").read_bytes()
    for name, damaged in mutations(whole, seed=7, count=60):
        (tmp_path / "photos.h5").write_bytes(damaged)
        with suppress(InputError):
            assert all(one.ndim == 3 for one in PhotoFile(tmp_path / "photos.h5").values()), name
