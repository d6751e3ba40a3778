import cv2
import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image, ImageCms

from exif_photos import STORED, save_photo
from slimsfm.errors import ImageError
from slimsfm.exif import camera_from_exif, read_exif
from slimsfm.limits import Limits, use_limits
from slimsfm.photos import read_image, read_mask, read_photo, read_stored_mask, shrink, upright

UPRIGHT = np.zeros((4, 6, 3), np.uint8)
UPRIGHT[0, 0], UPRIGHT[0, -1], UPRIGHT[-1, 0], UPRIGHT[-1, -1] = (
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
    (255, 255, 0),
)


def exif(orientation):
    data = Image.Exif()
    data[ExifTags.Base.Orientation] = orientation
    return data


def noise(height=40, width=60):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp"])
@pytest.mark.parametrize("orientation", STORED)
def test_images_are_read_upright_or_as_they_are_stored(tmp_path, orientation, suffix):
    upright = np.kron(UPRIGHT, np.ones((16, 16, 1), np.uint8))  # large blocks survive lossy formats
    path = save_photo(tmp_path / f"a.{suffix}", upright, orientation)
    stored = STORED[orientation](upright)
    for expected, read in ((upright, read_image(path)), (stored, read_image(path, "stored"))):
        assert read.shape == expected.shape
        assert np.abs(read[4::16, 4::16].astype(int) - expected[4::16, 4::16]).max() < 40
    if suffix != "webp":  # which COLMAP does not read
        seen_by_colmap = pycolmap.Bitmap.read(path, True).to_array()
        assert np.abs(read_image(path, "stored").astype(int) - seen_by_colmap).mean() < 1


DAMAGED_EXIF = [b"MM\0*", b"hello" * 5, b"II*\0" + b"\xff" * 30, b"II*\0\x08\0\0\0\xff\xff\x12\1\3"]


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp"])
@pytest.mark.parametrize("exif", DAMAGED_EXIF)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_images_with_damaged_exif_data_are_read_as_they_are_stored(tmp_path, suffix, exif):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(noise()).save(path, exif=b"Exif\0\0" + exif)
    assert np.array_equal(read_image(path), read_image(path, "stored"))
    assert read_exif(path).orientation == 1
    assert not read_exif(path).ignored


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "CMYK", "I;16"])
def test_every_color_mode_is_read_as_rgb(tmp_path, mode):
    gray = np.array([[0, 64], [128, 255]], np.uint8)
    values = gray.astype(np.uint16) * 257 if mode == "I;16" else gray
    image = Image.fromarray(values) if mode == "I;16" else Image.fromarray(gray).convert(mode)
    image.save(tmp_path / "a.tif")
    read = read_image(tmp_path / "a.tif")
    expected = gray if mode != "1" else np.asarray(image) * np.uint8(255)
    assert np.array_equal(read, np.repeat(expected[..., None], 3, axis=2))


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("suffix", ["png", "tif", "webp"])
def test_transparency_is_turned_with_its_image(tmp_path, orientation, suffix):
    pixels = np.dstack([UPRIGHT, np.full((4, 6), 255, np.uint8)])
    pixels[1, 2, 3], pixels[2, 3, 3] = 0, 1
    stored = np.ascontiguousarray(STORED[orientation](pixels))
    Image.fromarray(stored).save(tmp_path / f"a.{suffix}", exif=exif(orientation), lossless=True, exact=True)
    photo = read_photo(tmp_path / f"a.{suffix}")
    assert np.array_equal(photo.image, UPRIGHT)
    assert np.array_equal(photo.alpha, np.where(pixels[..., 3], 255, 0))
    assert photo.orientation == orientation
    camera = camera_from_exif(tmp_path / f"a.{suffix}")
    assert (camera.width, camera.height) == (6, 4)
    assert np.array_equal(upright(np.ascontiguousarray(STORED[orientation](UPRIGHT)), orientation), UPRIGHT)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "RGBA;16", "color key"])
@pytest.mark.parametrize("hole", [False, True])
def test_every_kind_of_transparency_is_read_and_opaque_images_have_none(tmp_path, mode, hole):
    gray, alpha = np.full((5, 7), 100, np.uint8), np.full((5, 7), 255, np.uint8)
    if hole:
        gray[2, 3], alpha[2, 3] = 7, 0
    if mode == "RGBA;16":
        cv2.imwrite(str(tmp_path / "a.png"), np.dstack([gray, gray, gray, alpha]).astype(np.uint16) * 257)
    elif mode in ("P", "color key"):
        made = Image.fromarray(gray) if mode == "color key" else Image.fromarray(gray).convert("P")
        made.save(tmp_path / "a.png", transparency=7)
    else:
        Image.merge("LA", [Image.fromarray(gray), Image.fromarray(alpha)]).convert(mode).save(
            tmp_path / "a.png"
        )
    photo = read_photo(tmp_path / "a.png")
    assert photo.image[0, 0].tolist() == [100] * 3
    assert np.array_equal(alpha if photo.alpha is None else photo.alpha, alpha)
    assert (photo.alpha is None) == (photo.visible is None) == (not hole)


def test_what_is_transparent_everywhere_is_visible_everywhere_to_a_query(tmp_path):
    Image.new("RGBA", (5, 4)).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    assert photo.alpha is not None
    assert not photo.alpha.any()
    assert photo.visible is None


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("kind", ["I;16 png", "I;16 tif", "RGB png", "RGB tif", "I tif", "F tif"])
def test_images_are_as_bright_in_any_bit_depth(tmp_path, bits, kind):
    mode, suffix = kind.split()
    shown = noise()[..., 0] if mode != "RGB" else noise()
    values = shown.astype(np.uint16) << (bits - 8)
    path = tmp_path / f"a.{suffix}"
    if mode == "RGB":
        cv2.imwrite(str(path), values[..., ::-1])
    else:
        Image.fromarray(values.astype({"I": np.int32, "F": np.float32}.get(mode, np.uint16))).save(path)
    read = read_image(path)
    assert np.array_equal(read, shown if mode == "RGB" else np.repeat(shown[..., None], 3, axis=2))


def test_floats_up_to_one_are_shares_of_white_and_what_is_no_number_is_black(tmp_path):
    values = np.array([[0, 0.5, 1, np.nan, -3, np.inf]], np.float32)
    Image.fromarray(values).save(tmp_path / "a.tif")
    assert read_image(tmp_path / "a.tif")[0, :, 0].tolist() == [0, 128, 255, 0, 0, 0]


def test_lab_is_read_as_rgb(tmp_path):
    image, (rgb, lab) = Image.new("RGB", (9, 5), (200, 100, 50)), map(ImageCms.createProfile, ("sRGB", "LAB"))
    ImageCms.profileToProfile(image, rgb, lab, outputMode="LAB").save(tmp_path / "a.tif")
    assert np.abs(read_image(tmp_path / "a.tif").astype(int) - np.asarray(image)).max() <= 3


@pytest.mark.parametrize("suffix", ["gif", "tif", "webp", "apng"])
def test_the_first_of_several_frames_is_read_and_said_so(tmp_path, suffix, caplog):
    frames = [Image.new("RGB", (20, 10), color) for color in ("white", "black", "red")]
    frames[0].save(tmp_path / f"a.{suffix}", save_all=True, append_images=frames[1:])
    photo = read_photo(tmp_path / f"a.{suffix}", warn=False)
    assert (photo.image > 250).all()
    assert photo.num_frames == 3
    assert not caplog.records
    read_image(tmp_path / f"a.{suffix}")
    assert f"a.{suffix}: the first of 3 frames" in caplog.text


def test_an_image_that_is_too_large_is_named_with_the_limit(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((2000, 3000), np.uint8)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4_000_000)
    assert read_image(tmp_path / "a.png").shape == (2000, 3000, 3)  # Pillow would warn
    with (
        use_limits(Limits(max_megapixels=5)),
        pytest.raises(
            ImageError,
            match=r"a\.png: has 6 megapixels, more than the limit of 5; shrink it or pass `max_megapixels=6`",
        ),
    ):
        read_image(tmp_path / "a.png")
    assert Image.MAX_IMAGE_PIXELS == 4_000_000


@pytest.mark.parametrize("mode", ["1", "L", "P", "LA", "RGB", "RGBA", "I;16", "I", "F", "RGB;16"])
@pytest.mark.parametrize("value", [1, 255])
def test_a_mask_keeps_what_is_not_black_in_any_mode_and_depth(tmp_path, mode, value):
    kept = noise()[..., 0] > 100
    path, gray = tmp_path / ("a.tif" if mode in ("I", "F") else "a.png"), kept * np.uint8(value)
    if mode == "RGB;16":
        cv2.imwrite(str(path), np.repeat(gray[..., None], 3, axis=2).astype(np.uint16))
    elif mode in ("I;16", "I", "F"):
        Image.fromarray(gray.astype({"I": np.int32, "F": np.float32}.get(mode, np.uint16))).save(path)
    else:
        Image.fromarray(kept if mode == "1" else gray).convert(mode).save(path)
    assert np.array_equal(read_mask(path), np.where(kept, 255, 0))
    assert np.array_equal(read_stored_mask(path).mask > 0, kept)


def test_what_is_transparent_in_a_mask_is_not_kept(tmp_path):
    pixels = np.full((3, 4, 4), 255, np.uint8)
    pixels[1, 2, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert np.argwhere(read_mask(tmp_path / "a.png") == 0).tolist() == [[1, 2]]


def test_masks_may_have_any_color(tmp_path):
    Image.fromarray(UPRIGHT).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png") > 0, UPRIGHT.any(axis=2))


@pytest.mark.parametrize("read", [read_image, read_mask, camera_from_exif])
@pytest.mark.parametrize("damage", ["text", "empty", "folder", "missing"])
def test_error_names_a_file_that_is_not_an_image(tmp_path, read, damage):
    path = tmp_path / "photo.jpg"
    if damage == "folder":
        path.mkdir()
    elif damage != "missing":
        path.write_text("hello" if damage == "text" else "")
    with pytest.raises(ImageError, match=r"photo\.jpg: (no such|not a readable) image"):
        read(path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "bmp", "tif"])
def test_truncated_file_is_an_image_error_at_any_length(tmp_path, suffix):
    path = tmp_path / f"photo.{suffix}"
    Image.fromarray(noise()).save(path)
    whole = path.read_bytes()
    for length in range(0, int(0.95 * len(whole)), len(whole) // 15):
        path.write_bytes(whole[:length])
        with pytest.raises(ImageError, match="photo"):
            read_image(path)


@pytest.mark.parametrize("shape", [(30, 40, 3), (40, 30), (7, 400)])
def test_shrinking_keeps_the_shape_and_leaves_small_images_alone(shape):
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    small = shrink(image, 20)
    assert max(small.shape[:2]) == 20
    assert small.shape[2:] == image.shape[2:]
    assert min(small.shape[:2]) == max(1, round(min(shape[:2]) * 20 / max(shape[:2])))
    assert shrink(image, max(shape[:2])) is image


def test_paths_may_be_strings(tmp_path):
    path = str(tmp_path / "a.png")
    Image.fromarray(noise()).save(path)
    assert np.array_equal(read_image(path), noise())
    assert read_mask(path).shape == (40, 60)
    assert camera_from_exif(path).width == 60
