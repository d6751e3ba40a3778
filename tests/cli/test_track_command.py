"""`slimsfm track` on short videos of one rendered object."""

import json
import shutil

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from commands import contents, slimsfm
from slimsfm.cli import run
from slimsfm.localization import Localizer
from slimsfm.photos import read_image
from slimsfm.report.tracked_video import draw_tracked
from slimsfm.tracking import Tracker, TrackerOptions
from slimsfm.tracking.video import open_frames, write_video


@pytest.fixture(scope="module")
def images(boulder):
    """The object from a still camera, a black frame, and the object from another viewpoint."""
    here, there = (read_image(boulder.photos / name) for name in ("12.png", "20.png"))
    return [here, here, here, np.zeros_like(here), there, there]


@pytest.fixture(scope="module")
def video(images, tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "film.mp4"
    with write_video(path, 25.0) as write:
        for image in images:
            write(image)
    return path


@pytest.fixture
def refused(tmp_path):
    def check(*arguments, naming):
        before = contents(tmp_path)
        outcome = slimsfm("track", *arguments)
        lines = [line for line in outcome.err.splitlines() if line.strip()]
        assert (outcome.code, len(lines)) == (2, 1), outcome
        assert lines[0].startswith("slimsfm: ")
        assert str(naming) in lines[0]
        assert contents(tmp_path) == before

    return check


def write_mjpeg(path, images):
    """A film whose files can be joined."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", 25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuvj420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def poses_of(path):
    return {image["name"]: image["cam_from_world"] for image in json.loads(path.read_text())["images"]}


def library_poses(map_, source, options=TrackerOptions()):
    tracker = Tracker(Localizer(map_), options)
    results = {frame.name: tracker.track(frame.image).pose for frame in open_frames(str(source)).pictures}
    return {name: pose and as_json(pose.cam_from_world) for name, pose in results.items()}


def as_json(cam_from_world):
    return {
        "quaternion_xyzw": cam_from_world.rotation.quat.tolist(),
        "translation": cam_from_world.translation.tolist(),
    }


def test_the_command_writes_the_poses_of_the_library(boulder, video, tmp_path):
    output = tmp_path / "poses.json"
    done = slimsfm("track", boulder.map_path, video, "-o", output)
    assert (done.code, done.err.strip()) == (0, "")
    summary, made = done.out.splitlines()
    assert f"{output}: 3 frames tracked, 2 localized from scratch, 1 lost; " in summary
    assert summary.endswith(" frames per second")
    assert made.startswith(f"{output}: 6 frames in ")
    poses = poses_of(output)
    assert poses == library_poses(boulder.map, video)
    assert [name for name, pose in poses.items() if pose is None] == ["000003"]


def test_options_reach_the_tracker(boulder, video, tmp_path):
    output = tmp_path / "poses.json"
    arguments = (
        "--smoothing",
        5,
        "--max-image-size",
        160,
        "--renew-every",
        2,
        "--lag",
        1,
        "--max-points",
        90,
    )
    assert slimsfm("track", boulder.map_path, video, "-o", output, *arguments).code == 0
    options = TrackerOptions(smoothing=5.0, max_image_size=160, renew_every=2, lag=1, max_points=90)
    assert poses_of(output) == library_poses(boulder.map, video, options)


def test_a_folder_is_tracked_image_by_image(boulder, images, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for i, image in enumerate(images[:3]):
        Image.fromarray(image).save(folder / f"{i}.png")
    done = slimsfm("track", boulder.map_path, folder, "-o", tmp_path / "poses.csv")
    assert done.code == 0
    assert "2 frames tracked, 1 localized from scratch, 0 lost" in done.out
    names = [line.split(",")[0] for line in (tmp_path / "poses.csv").read_text().splitlines()]
    assert names == ["name", "0.png", "1.png", "2.png"]


def test_a_camera_file_is_used_as_it_is_on_request(boulder, video, tmp_path):
    line = "1 PINHOLE 640 480 780 780 320 240\n"
    (tmp_path / "camera.txt").write_text(line)
    arguments = (boulder.map_path, video, "--camera", tmp_path / "camera.txt", "--focal", "known")
    doubted = ("--min-confidence", "0", "--begin-confidence", "0")  # the matches contradict this camera
    assert slimsfm("track", *arguments, *doubted, "-o", tmp_path / "other.json").code == 0
    assert slimsfm("track", boulder.map_path, video, "-o", tmp_path / "own.json").code == 0
    own, other = (
        poses_of(tmp_path / name)["000000"]["translation"][2] for name in ("own.json", "other.json")
    )
    assert other > 1.1 * own


def test_the_box_is_drawn_where_the_object_is_found(boulder, video, images, tmp_path):
    drawn = tmp_path / "drawn.mp4"
    done = slimsfm("track", boulder.map_path, video, "-o", tmp_path / "poses.json", "--video", drawn)
    assert done.code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawn.mp4", "poses.json"]
    frames = [frame.image for frame in open_frames(str(drawn)).pictures]
    assert len(frames) == len(images)
    changes = [np.abs(a.astype(int) - b).max(axis=2) for a, b in zip(frames, images, strict=True)]
    assert all(np.mean(change > 60) > 0.002 for change in changes[:3])
    assert changes[3].max() < 30  # lost: no box


def test_poses_carry_the_time_of_their_frame(boulder, video, tmp_path):
    for name in ("poses.json", "poses.tum"):
        assert slimsfm("track", boulder.map_path, video, "-o", tmp_path / name).code == 0
    times = [index / 25 for index in range(6)]
    rows = json.loads((tmp_path / "poses.json").read_text())["images"]
    assert [row["seconds"] for row in rows] == times
    trajectory = np.loadtxt(tmp_path / "poses.tum")
    assert trajectory[:, 0].tolist() == [times[index] for index in (0, 1, 2, 4, 5)]  # 3 is lost


def test_a_damaged_film_gives_the_poses_until_then_and_says_so(boulder, images, tmp_path):
    film = tmp_path / "film.mjpeg"
    smaller = [cv2.resize(images[0], (240, 180))]
    film.write_bytes(b"".join(_jpeg(image) for image in [*images[:3], *smaller]))
    arguments = ("-o", tmp_path / "poses.json", "--video", tmp_path / "drawn.mp4")
    done = slimsfm("track", boulder.map_path, film, *arguments)
    assert (done.code, done.err) == (0, "")
    warnings = [line for line in done.out.splitlines() if line.startswith("warning: ")]
    assert warnings == [
        f"warning: {film}: ends before frame 3, which has 240x180 pixels; the frames before have 320x240"
    ]
    poses = poses_of(tmp_path / "poses.json")
    assert list(poses) == ["000000", "000001", "000002"]
    assert all(poses.values())
    assert len(list(open_frames(tmp_path / "drawn.mp4").pictures)) == 3


def _jpeg(image):
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def test_progress_is_plain_lines_without_a_terminal(boulder, video, tmp_path, capsys):
    assert run(["track", str(boulder.map_path), str(video), "-o", str(tmp_path / "poses.json")]) == 0
    first, last = capsys.readouterr().err.splitlines()
    assert first == "track: 0 of 6"
    assert last.startswith("track: 6 of 6 in ")


def test_a_more_confident_pose_has_a_stronger_box(boulder, images):
    map_ = boulder.map
    (sure,) = [Tracker(Localizer(map_)).track(images[0])]
    changes = []
    for confidence in (1.0, 0.5, 0.01):
        pose = sure.pose.__class__(
            cam_from_world=sure.pose.cam_from_world, inliers=sure.pose.inliers, confidence=confidence
        )
        one = sure.__class__(localization=_with_pose(sure.localization, pose), state="tracked", seconds=0.1)
        drawn = draw_tracked(images[0], one, map_.box)
        changes.append(np.abs(drawn.astype(int) - images[0]).sum())
    assert changes[0] > 1.5 * changes[1] > 2 * changes[2] > 0


def _with_pose(localization, pose):
    return localization.__class__(**{**vars(localization), "pose": pose})


class FakeCamera:
    """Yields some images, then raises what Ctrl-C raises."""

    def __init__(self, images):
        self.images = [cv2.cvtColor(image, cv2.COLOR_RGB2BGR) for image in images]

    def isOpened(self):
        return True

    def get(self, _property):
        return 30.0

    def read(self):
        if not self.images:
            raise KeyboardInterrupt
        return True, self.images.pop(0)

    def release(self):
        pass


def test_ctrl_c_ends_a_live_camera_and_keeps_its_poses(boulder, images, tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda _index: FakeCamera(images[:3]))
    arguments = ("-o", tmp_path / "poses.json", "--video", tmp_path / "seen.mp4")
    done = slimsfm("track", boulder.map_path, 0, *arguments)
    assert done.code == 0
    assert list(poses_of(tmp_path / "poses.json")) == ["000000", "000001", "000002"]
    assert len(list(open_frames(str(tmp_path / "seen.mp4")).pictures)) == 3


def test_ctrl_c_before_the_first_frame_leaves_nothing(boulder, tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda _index: FakeCamera([]))
    arguments = ("-o", tmp_path / "poses.json", "--video", tmp_path / "seen.mp4")
    done = slimsfm("track", boulder.map_path, 0, *arguments)
    assert done.code == 130
    assert list(tmp_path.iterdir()) == []


def test_bad_videos(refused, boulder, video, tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    half = video.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(half[: len(half) // 2])
    (tmp_path / "empty").mkdir()
    for name in ("text.mp4", "cut.mp4", "empty", "missing.mp4"):
        source = tmp_path / name
        refused(boulder.map_path, source, "-o", tmp_path / "poses.json", naming=source)
    arguments = ("-o", tmp_path / "poses.json", "--video", tmp_path / "drawn.mp4")
    refused(boulder.map_path, tmp_path / "text.mp4", *arguments, naming=tmp_path / "text.mp4")
    refused(boulder.map_path, 97, *arguments, naming="97: no camera")


def test_a_folder_with_a_broken_or_a_larger_image_is_refused_if_strict(refused, boulder, images, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    Image.fromarray(images[0]).save(folder / "0.png")
    (folder / "1.png").write_text("no image")
    arguments = ("-o", tmp_path / "poses.json", "--video", tmp_path / "drawn.mp4", "--strict")
    refused(boulder.map_path, folder, *arguments, naming=folder / "1.png")
    Image.new("RGB", (640, 480)).save(folder / "1.png")
    refused(
        boulder.map_path, folder, *arguments, naming="1.png: has 640x480 pixels, the frames before 320x240"
    )


def test_bad_maps_outputs_and_options(refused, boulder, video, tmp_path):
    output = tmp_path / "poses.json"
    refused(tmp_path / "nowhere", video, "-o", output, naming=tmp_path / "nowhere")
    refused(boulder.map_path, video, "-o", tmp_path / "poses.xml", naming=tmp_path / "poses.xml")
    gif = tmp_path / "drawn.gif"
    refused(
        boulder.map_path, video, "-o", output, "--video", gif, naming=f"{gif}: videos are written as .mp4"
    )
    refused(boulder.map_path, video, naming="see slimsfm track --help")
    for option, value, naming in (
        ("--smoothing", -1, "smoothing must not be negative, got -1.0"),
        ("--lag", 0, "lag must be at least 1, got 0"),
        ("--camera", tmp_path / "missing.txt", "missing.txt"),
    ):
        refused(boulder.map_path, video, "-o", output, option, value, naming=naming)


def test_weights_are_an_option(refused, boulder, video, tmp_path, monkeypatch):
    monkeypatch.setenv("SLIMSFM_WEIGHTS", "")
    arguments = ("-o", tmp_path / "poses.json", "--weights", tmp_path / "none", "--device", "cpu")
    refused(boulder.map_path, video, *arguments, naming="none: no such folder of weights")


def test_a_camera_of_another_shape(refused, boulder, video, tmp_path):
    (tmp_path / "camera.txt").write_text("1 PINHOLE 240 320 300 300 120 160\n")
    arguments = ("-o", tmp_path / "poses.json", "--camera", tmp_path / "camera.txt")
    refused(
        boulder.map_path,
        video,
        *arguments,
        naming=f"{video}: 320x240 pixels, but the given camera",
    )
    with write_video(tmp_path / "upright.mp4", 25.0) as write:
        write(np.zeros((320, 240, 3), np.uint8))
    arguments = ("-o", tmp_path / "poses.json", "--focal", "known")
    refused(boulder.map_path, tmp_path / "upright.mp4", *arguments, naming="give --camera FILE")


def test_outputs_that_exist_or_are_the_input(refused, boulder, video, tmp_path):
    taken, film = tmp_path / "taken.json", shutil.copy(video, tmp_path / "film.mp4")
    taken.write_text("mine")
    refused(boulder.map_path, film, "-o", taken, naming=taken)
    taken = shutil.copy(taken, tmp_path / "taken.mp4")
    refused(boulder.map_path, film, "-o", tmp_path / "poses.json", "--video", taken, naming=taken)
    refused(
        boulder.map_path, film, "-o", tmp_path / "poses.json", "--video", film, "--overwrite", naming=film
    )


def test_images_that_cannot_be_used_are_skipped_and_the_others_do_not_notice(boulder, images, tmp_path):
    folder, good = tmp_path / "frames", tmp_path / "good"
    for i, image in enumerate(images[:3]):
        for parent in (folder, good):
            parent.mkdir(exist_ok=True)
            Image.fromarray(image).save(parent / f"{2 * i}.png")
    (folder / "1.png").write_bytes((folder / "0.png").read_bytes()[:5000])
    Image.fromarray(images[0][:100]).save(folder / "3.png")
    alone = slimsfm("track", boulder.map_path, good, "-o", tmp_path / "good.json")
    done = slimsfm("track", boulder.map_path, folder, "-o", tmp_path / "poses.json")
    assert alone.code == done.code == 0
    assert "5 frames, 2 skipped in " in done.out
    frames = {one["name"]: one for one in json.loads((tmp_path / "poses.json").read_text())["images"]}
    assert list(frames) == [f"{i}.png" for i in range(5)]
    assert frames["1.png"]["reason"].startswith("not a readable image")
    assert frames["3.png"]["reason"] == "has 320x100 pixels, the frames before 320x240"
    poses = {name: frames[name]["cam_from_world"] for name in ("0.png", "2.png", "4.png")}
    assert poses == poses_of(tmp_path / "good.json")
    strict = slimsfm("track", boulder.map_path, folder, "-o", tmp_path / "strict.json", "--strict")
    assert (strict.code, (tmp_path / "strict.json").exists()) == (2, False)
    assert "frames/1.png: not a readable image" in strict.err


def test_a_film_that_ends_early_is_tracked_as_far_as_it_goes(boulder, images, tmp_path):
    film, parts = tmp_path / "film.mjpeg", (images[:3], [images[0][:100]])
    for part in parts:
        write_mjpeg(tmp_path / "part.mjpeg", part)
        with film.open("ab") as file:
            file.write((tmp_path / "part.mjpeg").read_bytes())
    done = slimsfm("track", boulder.map_path, film, "-o", tmp_path / "poses.json")
    assert done.code == 0
    assert f"warning: {film}: ends before frame 3, which has 320x100 pixels" in done.out
    assert list(poses_of(tmp_path / "poses.json")) == ["000000", "000001", "000002"]
    strict = slimsfm("track", boulder.map_path, film, "-o", tmp_path / "strict.json", "--strict")
    assert (strict.code, (tmp_path / "strict.json").exists()) == (2, False)
    assert "ends before frame 3" in strict.err
