"""Poses of every format are those that were written, each for the photo that it is of."""

import json

import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.errors import InputError
from slimsfm.exif import read_exif
from slimsfm.geometry import rotation_error_deg
from slimsfm.mapping.conventions import CONVENTIONS, PoseConvention
from slimsfm.mapping.known_poses import FORMATS, pose_photos, read_given
from slimsfm.mapping.known_poses.matching import PhotosToPose
from slimsfm.synthetic.scene import look_at

SIZE = 64, 48
PINHOLE = [60.0, 61.0, 31.5, 24.5]  # COLMAP's pixels
CENTERS = [np.array([3 * np.cos(a), 3 * np.sin(a), 1 + a / 3]) for a in np.arange(6) * 0.4]
POSES = [look_at(center, np.zeros(3)) for center in CENTERS]


@pytest.fixture
def photos(tmp_path):
    """Six photos in a folder, whose names are the numbers of KITTI."""
    folder = tmp_path / "data" / "image_2"
    folder.mkdir(parents=True)
    for i in range(len(POSES)):
        Image.new("RGB", SIZE, (i, 0, 0)).save(folder / f"{i:06d}.png")
    return folder


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def read(path, folder, seconds=None, unit=None):
    found = names(folder)
    return pose_photos(
        read_given(path),
        PhotosToPose(folder=folder, names=found, seconds=seconds or {}),
        lambda some: {name: read_exif(folder / name) for name in some},
        sharing="auto",
        orientation="upright",
        unit=unit,
    )


def write_transforms(path, poses, **more):
    convention = PoseConvention(camera_to_world=True, opengl=True)
    frames = [
        {"file_path": name, "transform_matrix": four(convention.matrix(pose))} for name, pose in poses.items()
    ]
    fx, fy, cx, cy = PINHOLE
    file = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": SIZE[0], "h": SIZE[1], "frames": frames}
    path.write_text(json.dumps(file | more))
    return path


def four(pose):
    return np.vstack([pose.matrix(), [0, 0, 0, 1]]).tolist()


def write_nerfstudio(_folder, photos):
    folder = photos.parent
    return write_transforms(
        folder / "transforms.json",
        {f"./{photos.name}/{n}": p for n, p in zip(names(photos), POSES, strict=True)},
    )


def write_colmap(folder, photos):
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=PINHOLE, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, (name, pose) in enumerate(zip(names(photos), POSES, strict=True), start=1):
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=i), pose)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_text(folder / "sparse" / "0")
    return folder


def write_onepose(folder, photos):
    (folder / "poses_ba").mkdir()
    for i, pose in enumerate(POSES):
        np.savetxt(folder / "poses_ba" / f"{i}.txt", four(pose))
    photos.rename(photos.parent / "old")
    photos.mkdir()
    for i, path in enumerate(sorted((photos.parent / "old").iterdir())):
        path.rename(photos / f"{i}.png")
    fx, fy, cx, cy = PINHOLE
    (folder / "intrinsics.txt").write_text(f"fx: {fx}\nfy: {fy}\ncx: {cx - 0.5}\ncy: {cy - 0.5}\n")
    return folder


def write_tum(folder, photos):
    for i, path in enumerate(sorted(photos.iterdir())):
        path.rename(photos / f"{1305031102.175304 + i / 2:.6f}.png")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(POSES):
        inverse = pose.inverse()
        values = [1305031102.18 + i / 2, *inverse.translation, *inverse.rotation.quat]
        lines.append(" ".join(f"{value:.12f}" for value in values))
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    write_camera(folder)
    return folder / "groundtruth.txt"


def write_kitti(folder, photos):
    fx, fy, cx, cy = PINHOLE
    np.savetxt(folder / "00.txt", [pose.inverse().matrix().ravel() for pose in POSES])
    rows = [[fx, 0, cx - 0.5, 0], [0, fx, cy - 0.5, 0], [0, 0, 1, 0]]
    lines = [f"P{k}: " + " ".join(map(str, np.ravel(rows))) for k in range(4)]
    (photos.parent / "calib.txt").write_text("\n".join(lines).replace(f"0 {fx}", f"0 {fy}"))
    return folder / "00.txt"


def write_camera(folder):
    values = " ".join(map(str, PINHOLE))
    (folder / "cameras.txt").write_text(f"# one\n1 PINHOLE {SIZE[0]} {SIZE[1]} {values}\n")


WRITERS = {
    "nerfstudio": (write_nerfstudio, "metre"),
    "colmap": (write_colmap, "unknown"),
    "onepose": (write_onepose, "metre"),
    "tum": (write_tum, "metre"),
    "kitti": (write_kitti, "metre"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_gives_the_poses_and_intrinsics_that_were_written(photos, tmp_path, kind):
    write, unit = WRITERS[kind]
    known = read(write(tmp_path, photos), photos)
    assert known.unit == unit
    assert sorted(known.cam_from_world) == sorted(known.cameras) == names(photos)
    for name, pose in zip(names(photos), POSES, strict=True):
        found, camera = known.cam_from_world[name], known.cameras[name]
        assert np.allclose(found.translation, pose.translation, atol=1e-6)
        assert rotation_error_deg(found, pose) < 1e-4
        assert np.allclose(camera.params, PINHOLE)
        assert (camera.width, camera.height) == SIZE
    assert (
        read(write_camera_again(tmp_path), photos, unit="unknown").unit == "unknown"
        if kind == "tum"
        else True
    )


def write_camera_again(folder):
    return folder / "groundtruth.txt"


def test_every_format_is_tried():
    assert list(FORMATS) == ["nerfstudio", "colmap", "onepose", "trajectory"]


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_a_convention_gives_back_the_pose_that_its_matrix_states(convention):
    for pose in POSES:
        again = convention.cam_from_world(convention.matrix(pose))
        assert np.allclose(again.matrix(), pose.matrix())


@pytest.mark.parametrize("trace", ["ply_file_path", "aabb_scale", "camera_angle_x"])
def test_poses_of_structure_from_motion_have_no_unit(photos, tmp_path, trace):
    poses = dict(zip(names(photos), POSES, strict=True))
    path = write_transforms(tmp_path / "transforms.json", poses, **{trace: "x" if trace[0] == "p" else 1.0})
    assert read(path, photos).unit == "unknown"
    assert any(trace in note for note in read(path, photos).notes)
    assert read(path, photos, unit="metre").unit == "metre"


def test_intrinsics_of_a_frame_come_before_those_of_the_file_and_distortion_is_kept(photos, tmp_path):
    poses = dict(zip(names(photos), POSES, strict=True))
    path = write_transforms(tmp_path / "transforms.json", poses, k1=-0.1, p2=0.001)
    file = json.loads(path.read_text())
    file["frames"][0]["fl_x"] = 70.0
    path.write_text(json.dumps(file))
    cameras = read(path, photos).cameras
    first, second, third = (cameras[name] for name in names(photos)[:3])
    assert (first.focal_length_x, second.focal_length_x) == (70.0, 60.0)
    assert (second.model_name, second.params[4:].tolist()) == ("OPENCV", [-0.1, 0, 0, 0.001])
    assert first.camera_id != second.camera_id == third.camera_id


def test_fisheye_cameras_and_sizes_that_were_halved(photos, tmp_path):
    poses = dict(zip(names(photos), POSES, strict=True))
    double = {"w": 128, "h": 96, "fl_x": 120.0, "fl_y": 122.0, "cx": 63.0, "cy": 49.0}
    path = write_transforms(
        tmp_path / "transforms.json", poses, camera_model="OPENCV_FISHEYE", k1=0.01, **double
    )
    camera = read(path, photos).cameras[names(photos)[0]]
    assert camera.model_name == "OPENCV_FISHEYE"
    assert np.allclose(camera.params[:4], PINHOLE)


def test_names_may_lack_their_suffix_or_lead_elsewhere(photos, tmp_path):
    poses = {
        f"../somewhere/image_2/{name[:-4]}": pose for name, pose in zip(names(photos), POSES, strict=True)
    }
    known = read(write_transforms(tmp_path / "t.json", poses), photos)
    assert sorted(known.cam_from_world) == names(photos)


def test_two_poses_of_one_photo_are_refused(photos, tmp_path):
    poses = {f"{folder}/000000.png": POSES[i] for i, folder in enumerate("ab")}
    with pytest.raises(InputError, match=r"a/000000\.png and b/000000\.png may both be"):
        read(write_transforms(tmp_path / "t.json", poses), photos)


def test_photos_without_a_pose_and_poses_without_a_photo_are_named(photos, tmp_path):
    poses = {"000001.png": POSES[1], "000004.png": POSES[4], "gone.png": POSES[0]}
    known = read(write_transforms(tmp_path / "t.json", poses), photos)
    assert sorted(known.cam_from_world) == ["000001.png", "000004.png"]
    notes = " ".join(known.notes)
    assert "4 photos without a pose left out: 000000.png, 000002.png" in notes
    assert "1 pose without a photo ignored: gone.png" in notes


def test_times_of_nanoseconds_and_frames_of_videos(photos, tmp_path):
    path = write_tum(tmp_path, photos)
    for i, photo in enumerate(sorted(photos.iterdir())):
        photo.rename(photos / f"{1305031102175304000 + i * 500_000_000}.png")
    assert len(read(path, photos).cam_from_world) == 6
    for i, photo in enumerate(sorted(photos.iterdir())):
        photo.rename(photos / f"frame{i}.png")
    seconds = {name: 1305031102.1 + i / 2 for i, name in enumerate(names(photos)[:3])}
    seconds |= {name: 10.0 * i for i, name in enumerate(names(photos)[3:])}  # far from all
    assert sorted(read(path, photos, seconds=seconds).cam_from_world) == names(photos)[:3]
    with pytest.raises(InputError, match="name the photos by their times"):
        read(path, photos)


def broken(text):
    def write(tmp_path, _photos):
        (tmp_path / "poses.json").write_text(text)
        return tmp_path / "poses.json"

    return write


def of_lines(text):
    def write(tmp_path, _photos):
        (tmp_path / "poses.txt").write_text(text)
        return tmp_path / "poses.txt"

    return write


def no_intrinsics(tmp_path, photos):
    path = write_tum(tmp_path, photos)
    (tmp_path / "cameras.txt").unlink()
    return path


def other_photos(tmp_path, _photos):
    return write_transforms(tmp_path / "t.json", {f"{i}.jpg": pose for i, pose in enumerate(POSES)})


def turned(tmp_path, photos):
    poses = dict(zip(names(photos), POSES, strict=True))
    return write_transforms(tmp_path / "t.json", poses, w=SIZE[1], h=SIZE[0])


def scaled(tmp_path, photos):
    poses = dict(zip(names(photos), POSES, strict=True))
    path = write_transforms(tmp_path / "t.json", poses)
    file = json.loads(path.read_text())
    file["frames"][2]["transform_matrix"][0][0] = 5.0
    path.write_text(json.dumps(file))
    return path


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda tmp_path, _: tmp_path / "missing.json", "no such file or folder of poses"),
        (lambda _, photos: photos, "holds no poses in a known format"),
        (broken("[1, 2"), "must be a transforms.json"),
        (broken('{"frames": []}'), "holds no pose"),
        (broken('{"frames": [{"file_path": "a.png"}]}'), "without 'transform_matrix'"),
        (scaled, r"frame 2 \('000002.png'\) is not a pose"),
        (other_photos, r"has 6 poses, of 0.jpg, 1.jpg, ..., but none is of a photo in"),
        (turned, "orientation='stored'"),
        (of_lines("1 2 3\n4 5 6\n"), "its lines have 3 numbers"),
        (of_lines(""), "its lines have no numbers"),
        (of_lines("0 0 0 0 0 0 0 2\n"), "line 1: the quaternion has the length 2, not 1"),
        (of_lines("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4), "has 4 poses, but there are 6 photos"),
        (no_intrinsics, "has no intrinsics, and neither has EXIF of"),
    ],
)
def test_wrong_poses_are_refused_in_one_line(photos, tmp_path, write, says):
    with pytest.raises(InputError, match=says) as error:
        read(write(tmp_path, photos), photos)
    assert "\n" not in str(error.value)
