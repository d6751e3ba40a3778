import csv
import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pycolmap
import pytest

from scenes import camera, poses
from slimsfm.errors import OutputError
from slimsfm.localization import Localization, Seconds
from slimsfm.localization.pose_files import write_poses
from slimsfm.photos import Orientation
from slimsfm.pose import PoseEstimate

TRUTH = dict(zip(["a.png", "b/deep.jpg", "c,d.png", "lost.png", "z.png"], poses(5), strict=True))
FOUND = {name: pose for name, pose in TRUTH.items() if name != "lost.png"}


@pytest.fixture
def results():
    seconds = Seconds(extract=0.0101, match=0.002, pose=0.0003)
    inliers = np.arange(20) < 15
    return {
        name: Localization(
            pose=PoseEstimate(cam_from_world=TRUTH[name], inliers=inliers) if name in FOUND else None,
            camera=pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480),
            points2D=np.zeros((20, 2)),
            points3D_in_world=np.zeros((20, 3)),
            references=3,
            seconds=seconds,
        )
        for name in TRUTH
    }


def rigid(quaternion_xyzw, translation):
    rotation = pycolmap.Rotation3d(np.array(quaternion_xyzw, np.float64))
    return pycolmap.Rigid3d(rotation, np.array(translation, np.float64))


def assert_equal_poses(read):
    assert list(read) == list(FOUND)
    for name, pose in read.items():
        assert np.allclose(pose.matrix(), FOUND[name].matrix(), rtol=0, atol=1e-9)


def test_json_holds_the_poses_and_the_images_that_were_not_localized(results, tmp_path):
    write_poses(tmp_path / "poses.json", results)
    data = json.loads((tmp_path / "poses.json").read_text())
    assert "x_in_cam = R @ x_in_world + t" in data["convention"]
    images = {image["name"]: image for image in data["images"]}
    assert list(images) == list(TRUTH)
    lost = images["lost.png"]
    assert (lost["localized"], lost["cam_from_world"], lost["inliers"], lost["matches"]) == (
        False,
        None,
        0,
        20,
    )
    found = {name: image["cam_from_world"] for name, image in images.items() if image["localized"]}
    assert_equal_poses(
        {name: rigid(pose["quaternion_xyzw"], pose["translation"]) for name, pose in found.items()}
    )
    one = images["a.png"]
    assert (one["inliers"], one["ms_extract"], one["ms_match"], one["ms_pose"], one["ms_total"]) == (
        15,
        10.1,
        2.0,
        0.3,
        12.4,
    )


def test_csv_holds_the_poses_and_the_images_that_were_not_localized(results, tmp_path):
    write_poses(tmp_path / "poses.csv", results)
    with (tmp_path / "poses.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(TRUTH)
    assert rows["lost.png"]["qw"] == rows["lost.png"]["tz"] == ""
    assert rows["lost.png"]["inliers"] == "0"
    assert rows["a.png"]["ms_total"] == "12.4"
    assert_equal_poses(
        {
            name: rigid([row[q] for q in ("qx", "qy", "qz", "qw")], [row[t] for t in ("tx", "ty", "tz")])
            for name, row in rows.items()
            if row["qw"]
        }
    )


@pytest.mark.parametrize("name", ["poses.txt", "poses.tum"])
def test_tum_holds_the_poses_by_index(results, tmp_path, name):
    write_poses(tmp_path / name, results)
    table = np.loadtxt(tmp_path / name)
    names = list(TRUTH)
    assert_equal_poses({names[int(row[0])]: rigid(row[4:8], row[1:4]).inverse() for row in table})


def test_poses_of_frames_carry_their_times(results, tmp_path):
    seconds = dict(zip(TRUTH, [0.0, 0.04, 0.05, 0.3, 1.0], strict=True))
    for name in ("poses.json", "poses.csv", "poses.tum"):
        write_poses(tmp_path / name, results, seconds=seconds)
    data = json.loads((tmp_path / "poses.json").read_text())
    assert {image["name"]: image["seconds"] for image in data["images"]} == seconds
    assert "seconds: when" in data["convention"]
    with (tmp_path / "poses.csv").open(newline="") as file:
        assert {row["name"]: float(row["seconds"]) for row in csv.DictReader(file)} == seconds
    assert (tmp_path / "poses.tum").read_text().startswith("# seconds tx ")
    assert np.loadtxt(tmp_path / "poses.tum")[:, 0].tolist() == [seconds[name] for name in FOUND]


@pytest.mark.parametrize("times", [[None] * 5, [0.0, 0.1, None, 0.3, 0.4], [0.0, 0.1, 0.1, 0.2, 0.3]])
def test_a_trajectory_counts_frames_whose_times_are_unknown_or_do_not_increase(results, tmp_path, times):
    write_poses(tmp_path / "plain.tum", results)
    write_poses(tmp_path / "poses.tum", results, seconds=dict(zip(TRUTH, times, strict=True)))
    assert (tmp_path / "poses.tum").read_bytes() == (tmp_path / "plain.tum").read_bytes()


def test_poses_without_times_have_no_seconds(results, tmp_path):
    for name in ("poses.json", "poses.csv"):
        write_poses(tmp_path / name, results)
        assert "seconds" not in (tmp_path / name).read_text()


def test_colmap_reads_images_txt(results, tmp_path):
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera())
    model.write_text(tmp_path)
    for name in ("images.txt", "frames.txt", "rigs.txt"):
        (tmp_path / name).unlink()
    write_poses(tmp_path / "images.txt", results)
    read = pycolmap.Reconstruction()
    read.read_text(tmp_path)
    images = sorted(read.images.values(), key=lambda image: image.image_id)
    assert_equal_poses({image.name: image.cam_from_world() for image in images})


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_every_format_says_which_pixels_a_pose_is_of(results, tmp_path, orientation):
    turned = {name: replace(one, orientation=orientation) for name, one in results.items()}
    for name in ("poses.json", "poses.csv", "poses.tum", "images.txt"):
        write_poses(tmp_path / name, turned)
    data = json.loads((tmp_path / "poses.json").read_text())
    assert {image["orientation"] for image in data["images"]} == {orientation}
    assert "orientation: whether" in data["convention"]
    with (tmp_path / "poses.csv").open(newline="") as file:
        assert {row["orientation"] for row in csv.DictReader(file)} == {orientation}
    for name in ("poses.tum", "images.txt"):
        comments = [line for line in (tmp_path / name).read_text().splitlines() if line.startswith("#")]
        assert orientation in comments[-1]


@pytest.mark.parametrize("name", ["poses.xml", "poses", "poses.json.gz"])
def test_an_unknown_suffix_is_refused(results, tmp_path, name):
    with pytest.raises(OutputError, match=r"\.json, \.csv, \.txt or \.tum"):
        write_poses(tmp_path / name, results)
    assert list(tmp_path.iterdir()) == []


def test_poses_replace_a_file_only_when_allowed(results, tmp_path):
    path = tmp_path / "poses.json"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_poses(path, results)
    assert path.read_text() == "mine"
    write_poses(path, results, overwrite=True)
    assert json.loads(path.read_text())["images"]
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["poses.json", "poses.csv", "poses.txt", "images.txt"])
def test_equal_results_give_equal_bytes(results, tmp_path, name):
    write_poses(tmp_path / name, results)
    first = (tmp_path / name).read_bytes()
    write_poses(tmp_path / name, results, overwrite=True)
    assert (tmp_path / name).read_bytes() == first


@pytest.mark.parametrize("name", ["my query.png", "a\tb.png", "a\nb.png", " a.png"])
def test_names_that_colmap_would_cut_off_are_refused_and_the_other_formats_hold_them(results, tmp_path, name):
    named = {name: next(iter(results.values()))}
    with pytest.raises(
        OutputError, match=r"images\.txt cannot hold a name with spaces, .* write \.json or \.csv"
    ):
        write_poses(tmp_path / "images.txt", named)
    assert list(tmp_path.iterdir()) == []
    for file in ("poses.json", "poses.csv", "poses.txt"):
        write_poses(tmp_path / file, named)
    assert [one["name"] for one in json.loads((tmp_path / "poses.json").read_text())["images"]] == [name]
    with (tmp_path / "poses.csv").open(newline="", encoding="utf-8") as table:
        assert [row["name"] for row in csv.DictReader(table)] == [name]
