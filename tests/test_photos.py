import numpy as np
import pycolmap
import pytest
from PIL import Image

from exif_photos import STORED, save_photo
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import camera_from_exif, read_exif
from slimsfm.image_files import list_images
from slimsfm.photos import read_image, read_mask, shrink

UPRIGHT = np.zeros((4, 6, 3), np.uint8)
UPRIGHT[0, 0], UPRIGHT[0, -1], UPRIGHT[-1, 0], UPRIGHT[-1, -1] = (
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
    (255, 255, 0),
)


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


def test_images_are_listed_in_order_with_subfolders_and_without_hidden_ones(tmp_path):
    for name in ("b.JPG", "a 1.png", "sub/c.jpeg", "sub/deep/ä.webp", ".hidden.png", ".trash/d.png", "e.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert list_images(tmp_path) == ["a 1.png", "b.JPG", "sub/c.jpeg", "sub/deep/ä.webp"]


def test_folder_inside_a_hidden_one_is_not_hidden(tmp_path):
    folder = tmp_path / ".cache" / "photos"
    folder.mkdir(parents=True)
    (folder / "a.png").write_bytes(b"")
    assert list_images(folder) == ["a.png"]


def test_folder_without_images_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="contains no image"):
        list_images(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        list_images(tmp_path / "missing")


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
    assert list_images(str(tmp_path)) == ["a.png"]
