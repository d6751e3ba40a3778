"""Frames of a video: sharp, new, upright, the same on every run; a map of them is that of their files."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("av", reason="needs PyAV, which is not installed")

from commands import contents
from phone import cut_off, write_phone_video
from slimsfm.errors import InputError, VideoError
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.frames import extract_frames
from slimsfm.mapping.inputs import InputOptions, gather_photos
from slimsfm.mapping.io import write_map

RATE = 10  # frames per second of the films below


def texture(seed=0, height=240, width=1600):
    noise = np.random.default_rng(seed).uniform(0, 255, (height // 8, width // 8, 3)).astype(np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def pan(steps, blurred=()):
    """A camera that moves over a picture by these pixels from frame to frame; some frames are blurred."""
    picture, frames = texture(), []
    for index, left in enumerate(np.cumsum(steps)):
        frame = picture[:, left : left + 320]
        frames.append(cv2.blur(frame, (15, 1)) if index in blurred else frame)
    return frames


@pytest.fixture
def film(tmp_path):
    def write(frames, times_ms=None, name="film.mp4"):
        times = [1000 * i // RATE for i in range(len(frames))] if times_ms is None else times_ms
        write_phone_video(tmp_path / name, frames, times)
        return tmp_path / name

    return write


def test_two_frames_of_a_second_of_motion_and_one_of_a_standing_camera(film, tmp_path):
    moving = extract_frames(film(pan([12] * 40)), tmp_path / "moving")
    assert 7 <= len(moving.seconds) <= 10  # four seconds
    steps = np.diff(list(moving.seconds.values()))
    assert np.all((steps >= 0.25 - 1e-6) & (steps <= 0.75 + 1e-6))
    assert moving.num_read == 40
    standing = extract_frames(film(pan([0] * 40)), tmp_path / "standing")
    assert len(standing.seconds) == 1
    both = extract_frames(film(pan([12] * 20 + [0] * 30)), tmp_path / "both")
    assert max(both.seconds.values()) < 2.8
    more = extract_frames(film(pan([12] * 40)), tmp_path / "more", fps=5)
    assert len(more.seconds) > 1.8 * len(moving.seconds)


def test_the_sharpest_frames_are_chosen(film, tmp_path):
    blurred = [i for i in range(40) if i % 4]
    chosen = extract_frames(film(pan([12] * 40, blurred)), tmp_path / "frames")
    assert [int(name[:6]) % 4 for name in chosen.seconds] == [0] * len(chosen.seconds)


def test_frames_are_upright_numbered_and_equal_on_every_run(film, tmp_path):
    frames = pan([12] * 30)
    times = np.cumsum(np.random.default_rng(1).integers(40, 200, 30)).tolist()  # a rate that varies
    path = film(frames, times)
    first = extract_frames(path, tmp_path / "first")
    extract_frames(path, tmp_path / "second")
    assert contents(tmp_path / "first") == contents(tmp_path / "second")
    assert sorted(contents(tmp_path / "first")) == list(first.seconds)
    for name, seconds in first.seconds.items():
        index = int(name[:6])
        found = np.asarray(Image.open(tmp_path / "first" / name))
        assert found.shape == frames[index].shape
        assert np.median(np.abs(found.astype(int) - frames[index])) <= 8
        assert seconds == pytest.approx(times[index] / 1000, abs=1e-3)


def test_a_video_that_is_cut_off_is_used_up_to_there(film, tmp_path):
    path = film(pan([12] * 40))
    whole = extract_frames(path, tmp_path / "whole")
    cut_off(path, 0.6)
    part = extract_frames(path, tmp_path / "part")
    assert "film.mp4" in part.ended_early
    assert 3 <= len(part.seconds) < len(whole.seconds)
    assert part.num_read < 40
    with pytest.raises(VideoError, match=r"film\.mp4"):
        extract_frames(path, tmp_path / "strict", strict=True)


def test_an_empty_video_and_no_video_are_input_errors(tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.mp4: not a readable video"):
        extract_frames(tmp_path / "empty.mp4", tmp_path / "frames")
    with pytest.raises(InputError, match="no such video"):
        extract_frames(tmp_path / "none.mp4", tmp_path / "frames")
    with pytest.raises(ValueError, match="fps must be positive"):
        extract_frames(tmp_path / "none.mp4", tmp_path / "frames", fps=0)
    assert not (tmp_path / "frames").exists()


def test_several_sources_have_unique_names_and_finished_videos_are_not_read_again(film, tmp_path):
    for folder in ("a/photos", "b/photos"):
        (tmp_path / folder).mkdir(parents=True)
        Image.fromarray(texture()[:, :320]).save(tmp_path / folder / "1.png")
    path, work = film(pan([20] * 20)), tmp_path / "work"
    work.mkdir()
    sources = [tmp_path / "a" / "photos", path, tmp_path / "b" / "photos"]
    gathered = gather_photos(sources, work)
    found = sorted(contents(gathered.folder / "photos") | contents(gathered.folder / "photos-2"))
    assert found == ["1.png"]
    assert all(name.startswith("film/") and (gathered.folder / name).is_file() for name in gathered.seconds)
    assert "film.mp4: " in gathered.notes[0]
    before = {name: (gathered.folder / name).stat().st_mtime_ns for name in gathered.seconds}
    again = gather_photos(sources, work)
    assert again.seconds == gathered.seconds
    assert before == {name: (again.folder / name).stat().st_mtime_ns for name in again.seconds}
    record = work / "videos" / "film.json"
    record.write_text(json.dumps({"key": [], "frames": 3}))  # of another build
    assert gather_photos(sources, work).seconds == gathered.seconds
    only = gather_photos(sources[:1], work)
    assert only.folder == sources[0]
    with pytest.raises(InputError, match="is given twice"):
        gather_photos([path, path], work)
    with pytest.raises(InputError, match="single image"):
        gather_photos([sources[0] / "1.png"], work)


def test_a_video_gives_the_map_of_its_frames(rendered, tmp_path):
    frames = [np.asarray(Image.open(rendered.folder / name).convert("RGB")) for name in rendered.names]
    times = [0, 180, 260, 470, 600, 790, 850, 1100]
    write_phone_video(tmp_path / "take.mp4", frames, times)
    extract_frames(tmp_path / "take.mp4", tmp_path / "photos" / "take", fps=8)
    of_video = build_map(tmp_path / "take.mp4", inputs=InputOptions(fps=8.0))
    of_files = build_map(tmp_path / "photos")
    for name, made in (("video", of_video), ("files", of_files)):
        write_map(made, tmp_path / name)
    left, right = contents(tmp_path / "video"), contents(tmp_path / "files")
    assert {name for name in left | right if left.get(name) != right.get(name)} == {"map.json"}
    assert of_video.info.notes == (*of_video.info.notes[:1], *of_files.info.notes)
    assert len(of_video.images) >= 4


def test_an_interrupted_build_goes_on_with_the_same_frames(rendered, tmp_path):
    frames = [np.asarray(Image.open(rendered.folder / name).convert("RGB")) for name in rendered.names]
    write_phone_video(tmp_path / "take.mp4", frames, [150 * i for i in range(len(frames))])
    seen = {}

    def stops(items, label):
        seen[label] = len(items)
        for number, item in enumerate(items):
            if label == "extract features" and number == 2:
                raise KeyboardInterrupt
            yield item

    arguments = (tmp_path / "take.mp4", BuildOptions())
    more = {"inputs": InputOptions(fps=8.0), "workspace": tmp_path / "work", "progress": stops}
    with pytest.raises(KeyboardInterrupt):
        build_map(*arguments, **more)
    assert "choose frames of take.mp4" in seen
    seen.clear()
    build_map(*arguments, **more)
    assert "choose frames of take.mp4" not in seen
    assert any(label.startswith("extract features (2 done before)") for label in seen)
