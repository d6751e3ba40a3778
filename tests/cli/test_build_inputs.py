"""`slimsfm build` from videos and with known poses, and what it says of inputs that are wrong."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("av", reason="needs PyAV, which is not installed")

from commands import contents, slimsfm
from phone import cut_off, write_phone_video
from slimsfm.mapping.conventions import PoseConvention
from slimsfm.mapping.io import read_map
from slimsfm.synthetic.scene import mapping_take

COUNT = 8
OPENGL, OPENCV = (PoseConvention(camera_to_world=True, opengl=opengl) for opengl in (True, False))


@pytest.fixture(scope="module")
def take():
    return mapping_take("printed_box", 80, 320, 240, 0)


@pytest.fixture
def place(take, tmp_path):
    (tmp_path / "photos").mkdir()
    for i in range(COUNT):
        Image.fromarray(take.frame(i)).save(tmp_path / "photos" / f"{i}.png", compress_level=1)
    write_transforms(tmp_path, take, range(COUNT))
    return tmp_path


def write_transforms(folder, take, numbers, convention=OPENGL, name="photos/{}.png"):
    matrix = take.camera.calibration_matrix()
    camera = {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2], "w": 320}
    frames = []
    for i in numbers:
        pose = np.vstack([convention.matrix(take.cam_from_object[i]).matrix(), [0, 0, 0, 1]])
        frames.append({"file_path": name.format(i), "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps(camera | {"h": 240, "frames": frames}))


def refused(place, *arguments, naming):
    before = contents(place)
    outcome = slimsfm("build", *arguments, "-o", place / "map", "--workers", "1")
    assert outcome.code == 2
    (line,) = [line for line in outcome.err.splitlines() if line.strip()]
    assert line.startswith("slimsfm: ")
    for text in naming:
        assert str(text) in line
    assert contents(place) == before


def test_a_map_of_some_of_the_photos_has_the_unit_of_the_poses_and_names_the_others(place, take):
    write_transforms(place, take, range(1, 7))
    outcome = slimsfm("build", place / "photos", "--poses", place, "-o", place / "map", "--workers", "1")
    assert outcome.code == 0, outcome.err
    assert "metre unit" in outcome.out
    assert "note: 2 photos without a pose left out: 0.png, 7.png" in outcome.out
    assert "--unit unknown says otherwise" in outcome.out
    made = read_map(place / "map")
    assert (sorted(made.images), made.info.unit) == ([f"{i}.png" for i in range(1, 7)], "metre")
    assert made.info.notes


def test_poses_of_other_photos_and_of_other_axes(place, take):
    poses = ("--poses", place / "transforms.json")
    write_transforms(place, take, range(COUNT), name="images/frame_{}.jpg")
    refused(
        place, place / "photos", *poses, naming=["transforms.json", "has 8 poses", "none is of a photo in"]
    )
    write_transforms(place, take, range(COUNT), convention=OPENCV)
    naming = ["read as camera to world, OpenGL axes", "if they are camera to world, OpenCV axes"]
    refused(place, place / "photos", *poses, naming=naming)
    (place / "transforms.json").write_text("{")
    refused(place, place / "photos", *poses, naming=[place / "transforms.json"])
    refused(place, place / "photos", "--poses", place / "nowhere", naming=[place / "nowhere"])
    refused(place, place / "photos", "--refine", naming=["refine is about known poses"])


def test_videos_that_are_empty_cut_off_too_early_or_missing(place, take):
    (place / "empty.mp4").touch()
    refused(place, place / "empty.mp4", naming=["empty.mp4: not a readable video"])
    refused(place, place / "gone.mp4", naming=["gone.mp4: no such folder of images and no such video"])
    refused(place, place / "photos" / "1.png", naming=["is a single image"])
    refused(place, naming=["IMAGES"])
    frames = [take.frame(i) for i in range(COUNT)]
    write_phone_video(place / "film.mp4", frames, [500 * i for i in range(COUNT)])
    cut_off(place / "film.mp4", 0.0)
    refused(place, place / "film.mp4", naming=["film.mp4"])
    write_phone_video(place / "still.mp4", frames[:1] * 20, [50 * i for i in range(20)])
    refused(place, place / "still.mp4", naming=["still.mp4: holds 1 image; a map needs at least two"])


def test_a_video_that_is_cut_off_is_used_up_to_there_and_strict_refuses_it(place, take):
    frames = [take.frame(i) for i in range(18)]
    write_phone_video(place / "film.mp4", frames, [500 * i for i in range(18)])
    cut_off(place / "film.mp4", 0.8)
    refused(place, place / "film.mp4", "--strict", naming=["film.mp4: "])
    shutil.rmtree(place / "photos")
    outcome = slimsfm("build", place / "film.mp4", "-o", place / "map", "--workers", "1")
    assert outcome.code == 0, outcome.err
    assert "its frames until there are used" in outcome.out
    assert "/.map.build/" not in outcome.out
    assert all(name.startswith("film/0000") for name in read_map(place / "map").images)
