import numpy as np
import pytest
from PIL import Image

from slimsfm.datasets.base import largest_distance
from slimsfm.datasets.reading import folders, image_size
from slimsfm.errors import InputError
from slimsfm.mapping.known_poses.values import numbered, pinhole_camera, rigid
from slimsfm.synthetic.scene import mapping_path

SIDEWAYS = 6  # EXIF's orientation of a photo taken upright


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_the_size_of_an_image_follows_its_exif_rotation(tmp_path, suffix):
    exif = Image.Exif()
    exif[0x0112] = SIDEWAYS
    Image.new("RGB", (64, 48)).save(tmp_path / f"plain{suffix}")
    Image.new("RGB", (64, 48)).save(tmp_path / f"turned{suffix}", exif=exif)
    assert image_size(tmp_path / f"plain{suffix}") == (64, 48)
    assert image_size(tmp_path / f"turned{suffix}") == (48, 64)


def test_a_rounded_rotation_is_normalized():
    pose = mapping_path(5, 0.5)[2]
    read = rigid(pose.matrix().round(4), "file")
    rotation = read.matrix()[:, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.allclose(read.matrix(), pose.matrix(), atol=1e-3)


def test_the_center_of_the_first_pixel_moves_by_half_a_pixel():
    camera = pinhole_camera(np.array([[100.0, 0, 0], [0, 100, 0], [0, 0, 1]]), (64, 48), "file")
    assert np.allclose(camera.img_from_cam(np.array([[0.0, 0, 1]])), (0.5, 0.5))


def test_folders_and_files_come_in_the_order_of_their_numbers(tmp_path):
    for name in ("cup-10", "cup-2", ".hidden"):
        (tmp_path / name).mkdir()
    for name in ("10-pose.txt", "0009-pose.txt", "9-box.txt", "last-pose.txt"):
        (tmp_path / name).write_text("")
    assert [path.name for path in folders(tmp_path)] == ["cup-2", "cup-10"]
    assert [path.name for path in numbered(tmp_path, "-pose.txt").values()] == [
        "0009-pose.txt",
        "10-pose.txt",
    ]
    with pytest.raises(InputError, match=r"holds no file 0\.png, 1\.png"):
        numbered(tmp_path, ".png")


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_the_largest_distance_agrees_with_brute_force(flat):
    points = np.random.default_rng(0).normal(size=(200, 3)) * (1, 1, 0 if flat else 1)
    expected = np.linalg.norm(points[:, None] - points[None], axis=2).max()
    assert largest_distance(points) == pytest.approx(expected)


@pytest.mark.parametrize(("focal", "center"), [(1e300, 30), (0.1, 30), (100, 1e6)])
def test_an_impossible_matrix_is_named(focal, center):
    matrix = np.array([[focal, 0, center], [0, focal, 20], [0, 0, 1.0]])
    with pytest.raises(InputError, match=r"K\.txt: the camera is impossible: its .* correct the matrix"):
        pinhole_camera(matrix, (64, 48), "K.txt")
