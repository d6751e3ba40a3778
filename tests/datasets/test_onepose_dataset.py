import pickle
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slimsfm.datasets.base import map_object
from slimsfm.datasets.onepose import OnePose
from slimsfm.errors import InputError
from slimsfm.geometry import project

FRAMES = 17
NAME = "0408-colorbox-box"
FULL = np.array([[110.25, 0, 47.5], [0, 111.0, 35.25], [0, 0, 1]])
CROPS = [
    np.array([[900.0 + k, 0, 250.0 - 3 * k], [0, 910.0 + 2 * k, 260.0 + k], [0, 0, 1]]) for k in range(FRAMES)
]


@pytest.fixture
def published(tmp_path, known, write_onepose):
    sequences = ("colorbox-10", "colorbox-1")
    write_onepose(tmp_path / "test_data" / NAME, known, FRAMES, CROPS, FULL, sequences)
    (tmp_path / "test_data" / NAME / "colorbox-2").mkdir()  # neither the first nor the last, and so not read
    return OnePose(path=tmp_path / "test_data", frame_step=5)


def corners_of(box):
    return np.sort(box.corners.round(12), axis=0)


def test_full_frames_have_the_camera_of_the_video(published, known, making):
    made = published.load(NAME, making)
    for sequence, folder in ((made.mapping, "colorbox-1"), (made.query, "colorbox-10")):
        assert sequence.folder == published.path / NAME / folder / "color_full"
        assert sequence.names == ("0.png", "5.png", "10.png", "15.png")
        assert {(camera.width, camera.height) for camera in sequence.cameras} == {(96, 72)}
        known.check(sequence, (0, 5, 10, 15), [FULL] * 4)
    assert (made.name, made.unit, made.model, made.truth) == (NAME, "metre", None, None)
    assert np.array_equal(corners_of(made.box), corners_of(known.box))


def test_each_crop_has_its_own_camera(published, known, making):
    made = replace(published, frames="cropped").load(NAME, making)
    assert made.mapping.folder == published.path / NAME / "colorbox-1" / "color"
    assert {(camera.width, camera.height) for camera in made.query.cameras} == {(512, 512)}
    known.check(made.mapping, (0, 5, 10, 15), CROPS[::5])
    known.check(made.query, (0, 5, 10, 15), CROPS[::5])


def test_two_frames_per_second_are_read_by_default(published, making):
    made = OnePose(path=published.path).load(NAME, making)
    assert made.mapping.names == ("0.png", "15.png")
    with pytest.raises(ValueError, match="frame_step must be at least 1, got 0"):
        OnePose(path=published.path, frame_step=0)


def test_objects_are_sorted_and_can_be_pickled(published, known, making, write_onepose):
    write_onepose(published.path / "0050-aptamil-box", known, 1, CROPS)
    assert published.names() == ("0050-aptamil-box", NAME)
    travelled = pickle.loads(pickle.dumps(published))
    assert travelled == published
    assert travelled.load(NAME, making).mapping.names == published.load(NAME, making).mapping.names


def test_only_numbered_folders_are_sequences(published, making):
    for name in ("outputs", "colorbox-annotate"):
        (published.path / NAME / name).mkdir()
    assert published.load(NAME, making).query.folder.parent.name == "colorbox-10"


def test_a_folder_of_splits_and_an_unknown_object_are_errors(published, making):
    with pytest.raises(InputError, match="holds test_data: pass the folder"):
        OnePose(path=published.path.parent).names()
    with pytest.raises(InputError, match="has no object 'cup'; it has 0408-colorbox-box"):
        published.load("cup", making)


def test_missing_full_frames_are_an_error_that_mentions_crops(tmp_path, known, making, write_onepose):
    write_onepose(tmp_path / NAME, known, 2, CROPS)
    with pytest.raises(InputError, match=r"color_full is missing: .*`frames='cropped'`"):
        OnePose(path=tmp_path).load(NAME, making)
    assert OnePose(path=tmp_path, frames="cropped").load(NAME, making).mapping.names == ("0.png",)


def test_a_video_with_more_frames_than_poses_is_an_error(published, making, write_image):
    extra = published.path / NAME / "colorbox-1" / "color_full" / "17.png"
    write_image(extra, 96, 72)
    with pytest.raises(
        InputError, match=r"17\.png has no pose in poses_ba: .*18 frames.*17 .*`frames='cropped'`"
    ):
        published.load(NAME, making)
    assert len(replace(published, frames="cropped").load(NAME, making).mapping.names) == 4


PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0"
DAMAGES = {
    "no box": ("full", "box3d_corners.txt", None, "no such file"),
    "box of words": ("full", "box3d_corners.txt", "a b c\n" * 8, "8 corners"),
    "no intrinsics": ("full", "colorbox-1/intrinsics.txt", None, "there is no such file"),
    "no focal length": ("full", "colorbox-1/intrinsics.txt", "fx: 0\nfy: 1\ncx: 1\ncy: 1", "positive focal"),
    "infinite principal point": (
        "full",
        "colorbox-10/intrinsics.txt",
        "fx: 1\nfy: 1\ncx: inf\ncy: 1",
        "finite principal point",
    ),
    "cut frame": ("full", "colorbox-10/color_full/5.png", PNG, "cannot be read as an image"),
    "no pose": ("full", "colorbox-1/poses_ba/3.txt", None, "3.png has no pose"),
    "pose not finite": ("full", "colorbox-1/poses_ba/5.txt", "1 0 0 nan\n" * 4, "finite"),
    "no rotation": ("cropped", "colorbox-1/poses_ba/0.txt", "1 0 0 0\n" * 3 + "0 0 0 1", "rotation"),
    "no crop": ("cropped", "colorbox-10/color/4.png", None, "4.txt has no frame"),
    "cut crop": ("cropped", "colorbox-10/color/0.png", PNG, "cannot be read as an image"),
    "no matrix": ("cropped", "colorbox-1/intrin_ba/4.txt", None, "4.png has no matrix"),
    "matrix of words": ("cropped", "colorbox-1/intrin_ba/0.txt", "a b c\n" * 3, "3 rows of 3"),
    "small matrix": ("cropped", "colorbox-1/intrin_ba/0.txt", "1 0\n0 1\n", "3 rows of 3"),
    "skewed matrix": ("cropped", "colorbox-1/intrin_ba/0.txt", "9 1 4\n0 9 4\n0 0 1", "no skew"),
    "scaled matrix": ("cropped", "colorbox-1/intrin_ba/0.txt", "9 0 4\n0 9 4\n0 0 2", "9 0 4 0 9 4 0 0 2"),
}


@pytest.mark.parametrize(("frames", "path", "content", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_wrong_file_is_named_in_the_error(published, making, damage, frames, path, content, message):
    damage(published.path / NAME / path, content)
    with pytest.raises(InputError, match=message) as error:
        replace(published, frames=frames).load(NAME, making)
    named = path if content is not None or "/" not in path else path.split("/")[0]
    assert str(published.path / NAME / named) in str(error.value)
    assert "\n" not in str(error.value)


def test_frames_of_several_sizes_are_an_error(published, making, write_image):
    write_image(published.path / NAME / "colorbox-1" / "color_full" / "10.png", 48, 36)
    with pytest.raises(InputError, match=r"10\.png has 48x36 pixels, but 0\.png has 96x72"):
        published.load(NAME, making)


def test_a_rendered_object_in_the_published_layout_gives_the_same_map(
    rendered, rendered_map, making, crop, tmp_path
):
    dataset, ours = rendered
    root = shutil.copytree(dataset.path, tmp_path / "published")
    for sequence in (ours.mapping, ours.query):
        folder = root / "printed_box" / sequence.folder.parent.name
        (folder / "intrin_ba").mkdir()
        for name, camera, pose in zip(sequence.names, sequence.cameras, sequence.cam_from_world, strict=True):
            corners = project(ours.box.corners, pose, camera) - 0.5
            low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
            moved = crop(sequence.folder / name, folder / "color" / name, low, high)
            K = camera.calibration_matrix() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
            np.savetxt(folder / "intrin_ba" / name.replace(".png", ".txt"), moved @ K)
    full = OnePose(path=root, frame_step=1).load("printed_box", making)
    cropped = OnePose(path=root, frame_step=1, frames="cropped").load("printed_box", making)
    for name in ("mapping", "query"):
        for theirs in (getattr(full, name), getattr(cropped, name)):
            pairs = zip(getattr(ours, name).cam_from_world, theirs.cam_from_world, strict=True)
            assert all(np.array_equal(a.matrix(), b.matrix()) for a, b in pairs)
    assert map_object(full, tmp_path / "full").fingerprint == rendered_map.fingerprint
    assert_same_colors_where_points_project(rendered_map, full.mapping, cropped.mapping)


def assert_same_colors_where_points_project(map_, full, cropped):
    """Of a point's surroundings a crop shows what the frame shows; half a pixel off and it does not."""
    name = max(map_.observations, key=lambda name: len(map_.observations[name].points))
    i, points = full.names.index(name), map_.points3D_in_world[map_.observations[name].points]
    frame, crop = (cv2.imread(str(one.image_paths[i]), 0).astype(np.float32) for one in (full, cropped))
    pixels = [project(points, one.cam_from_world[i], one.cameras[i]) - 0.5 for one in (full, cropped)]
    inside = np.all((pixels[1] > 8) & (pixels[1] < 503), axis=1)
    assert inside.sum() > 20
    of_frame = sampled(frame, pixels[0][inside])
    here, *neighbors = (
        np.abs(sampled(crop, pixels[1][inside] + shift) - of_frame).mean() for shift in (0.0, -0.5, 0.5)
    )
    assert here < 0.7 * min(neighbors)


def sampled(image, pixels):
    return cv2.remap(image, *pixels.astype(np.float32).T, cv2.INTER_LINEAR).ravel()
