import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.datasets import onepose
from slimsfm.errors import ImageError, InputError
from slimsfm.geometry import Box, corner_error
from slimsfm.synthetic.scene import mapping_path

CAMERA = pycolmap.Camera(model="PINHOLE", width=16, height=12, params=[15.25, 15.5, 8.125, 5.875])
BOX = Box(np.zeros(3), np.diag([0.08, 0.035, 0.11]))
POSES = mapping_path(12, 0.5)


def write_object(folder, sequences=("cup-1", "cup-2")):
    onepose.write_box(folder, BOX)
    for sequence in sequences:
        onepose.write_annotation(folder / sequence, CAMERA, POSES)
        for number in range(len(POSES)):
            image = np.full((12, 16, 3), 10 * number, np.uint8)
            Image.fromarray(image).save(onepose.image_path(folder / sequence, number))
    return folder


def test_written_sequences_can_be_read(tmp_path):
    read = onepose.read_object(write_object(tmp_path / "cup"))
    assert read.name == "cup"
    assert np.allclose(read.mapping.cameras[0].params, CAMERA.params)
    assert (read.mapping.cameras[0].width, read.mapping.cameras[0].height) == (16, 12)
    assert max(corner_error(a, b, BOX) for a, b in zip(read.query.cam_from_world, POSES, strict=True)) < 1e-12
    gaps = np.linalg.norm(read.box.corners[:, None] - BOX.corners[None], axis=2)
    assert np.allclose(gaps.min(axis=0), 0)


def test_frames_come_in_the_order_of_their_numbers(tmp_path):
    read = onepose.read_object(write_object(tmp_path / "cup"))
    assert [int(path.stem) for path in read.mapping.image_paths] == list(range(12))
    assert np.asarray(Image.open(read.mapping.image_paths[10]))[0, 0, 0] == 100


def test_a_frame_step_uses_every_kth_frame_with_its_pose(tmp_path):
    read = onepose.read_object(write_object(tmp_path / "cup"), frame_step=5)
    assert [path.stem for path in read.query.image_paths] == ["0", "5", "10"]
    assert corner_error(read.query.cam_from_world[2], POSES[10], BOX) < 1e-12
    with pytest.raises(ValueError, match="frame_step must be at least 1"):
        onepose.read_object(tmp_path / "cup", frame_step=0)


def test_the_first_sequence_is_for_mapping_and_the_last_for_queries(tmp_path):
    read = onepose.read_object(write_object(tmp_path / "cup", ("cup-10", "cup-2", "cup-1")))
    assert read.mapping.image_paths[0].parts[-3] == "cup-1"
    assert read.query.image_paths[0].parts[-3] == "cup-10"


def test_a_dataset_is_its_objects_by_name(tmp_path):
    for name in ("cup", "box"):
        write_object(tmp_path / name)
    assert onepose.object_names(tmp_path) == ("box", "cup")


def test_files_follow_the_published_conventions(tmp_path):
    folder = write_object(tmp_path / "cup")
    signs = np.sign(np.loadtxt(folder / "box3d_corners.txt"))
    loop = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    assert signs.tolist() == [[x, y, z] for y in (-1, 1) for x, z in loop]
    assert (folder / "cup-1" / "intrinsics.txt").read_text() == "fx: 15.25\nfy: 15.5\ncx: 7.625\ncy: 5.375"
    assert np.allclose(np.loadtxt(folder / "cup-1" / "poses_ba" / "3.txt")[:3], POSES[3].matrix())


DAMAGES = {
    "no box": ("box3d_corners.txt", None, "no such file"),
    "seven corners": ("box3d_corners.txt", "0 0 0\n" * 7, "8 points"),
    "flat box": ("box3d_corners.txt", "0 0 0\n" * 8, "half_edges"),
    "no intrinsics": ("cup-1/intrinsics.txt", None, "cannot be read"),
    "no cy": ("cup-1/intrinsics.txt", "fx: 1\nfy: 1\ncx: 1\n", "must have the lines"),
    "word for number": ("cup-1/intrinsics.txt", "fx: a\nfy: 1\ncx: 1\ncy: 1\n", "must have the lines"),
    "negative focal length": ("cup-1/intrinsics.txt", "fx: -1\nfy: 1\ncx: 1\ncy: 1\n", "positive focal"),
    "3x4 pose": ("cup-2/poses_ba/4.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "4 rows of 4"),
    "ragged pose": ("cup-2/poses_ba/4.txt", "1 0 0 0\n0 1 0\n", "4 rows of 4"),
    "pose of words": ("cup-2/poses_ba/4.txt", "a b c d\n" * 4, "4 rows of 4"),
    "empty pose": ("cup-2/poses_ba/4.txt", "", "4 rows of 4"),
    "not finite": ("cup-2/poses_ba/4.txt", "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "finite"),
    "scaled rotation": ("cup-2/poses_ba/4.txt", "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "rotation"),
    "mirror": ("cup-2/poses_ba/4.txt", "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "rotation"),
    "odd last row": ("cup-2/poses_ba/4.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", "last row"),
}


@pytest.mark.parametrize(("path", "text", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_file_is_named_with_its_required_content(tmp_path, path, text, message):
    damaged = write_object(tmp_path / "cup") / path
    damaged.unlink() if text is None else damaged.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        onepose.read_object(tmp_path / "cup")
    assert str(damaged) in str(error.value)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("cup-1/poses_ba/7.txt", "color_full/7.png has no pose"),
        ("cup-1/color_full/7.png", "7.txt has no frame"),
    ],
)
def test_a_frame_without_pose_or_a_pose_without_frame_is_an_error(tmp_path, path, message):
    (write_object(tmp_path / "cup") / path).unlink()
    with pytest.raises(InputError, match=message):
        onepose.read_object(tmp_path / "cup")


def test_a_damaged_image_is_named_in_the_error(tmp_path):
    image = onepose.image_path(write_object(tmp_path / "cup") / "cup-1", 0)
    image.write_bytes(b"no image")
    with pytest.raises(ImageError, match="cannot be read as an image") as error:
        onepose.read_object(tmp_path / "cup")
    assert str(image) in str(error.value)


def test_a_single_sequence_is_an_error(tmp_path):
    with pytest.raises(InputError, match="holds 1 of the sequences"):
        onepose.read_object(write_object(tmp_path / "cup", ["cup-1"]))


def test_a_folder_without_objects_or_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(InputError, match="holds no folder"):
        onepose.object_names(tmp_path)
    with pytest.raises(InputError, match="is not a folder"):
        onepose.object_names(tmp_path / "missing")


def test_a_camera_with_distortion_cannot_be_written(tmp_path):
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=16, height=12, params=[15, 8, 6, 0.1])
    with pytest.raises(ValueError, match="camera must be a pinhole camera"):
        onepose.write_annotation(tmp_path, camera, POSES)
