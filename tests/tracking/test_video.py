import sys

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from commands import contents
from exif_photos import STORED, save_photo
from slimsfm.errors import ImageError, InputError, OutputError
from slimsfm.tracking.video import VIDEO_FORMATS, open_frames, write_video


def pictures(count=6, height=120, width=160):
    """Images of one color on the left and another on the right, which compression hardly changes."""
    made = np.full((count, height, width, 3), 200, np.uint8)
    made[:, :, : width // 2] = (20 + 30 * np.arange(count))[:, None, None, None]
    return made


def write(path, images, rate=25.0, **options):
    with write_video(path, rate, **options) as add:
        for image in images:
            add(image)


@pytest.mark.parametrize("suffix", VIDEO_FORMATS)
@pytest.mark.parametrize("size", [(120, 160), (121, 161)], ids=str)
def test_written_video_is_read_back(tmp_path, suffix, size):
    path, images = tmp_path / f"film{suffix}", pictures(6, *size)
    write(str(path), images)
    assert [path.name for path in tmp_path.iterdir()] == [path.name]
    frames = open_frames(str(path))
    assert frames.count in (6, None)
    assert frames.frames_per_second == 25
    assert not frames.is_live
    read = list(frames.pictures)
    assert [frame.name for frame in read] == [f"{i:06d}" for i in range(6)]
    for image, frame in zip(images, read, strict=True):
        height, width = size
        assert frame.image.shape == (height + height % 2, width + width % 2, 3)
        assert np.median(np.abs(frame.image[:height, :width].astype(int) - image)) <= 3


@pytest.mark.parametrize("tag", STORED)
def test_images_of_a_folder_are_read_in_the_pixels_of_the_map(tmp_path, tag):
    image = pictures(1)[0]
    save_photo(tmp_path / "a.png", image, tag)
    (upright,), (stored,) = (open_frames(tmp_path, way).pictures for way in ("upright", "stored"))
    assert np.array_equal(upright.image, image)
    assert np.array_equal(stored.image, STORED[tag](image))


def rotate_in_header(path):
    """Set the header to be displayed rotated to the right, like the video of a phone held upright."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    matrix = [0, 1 << 16, 0, (1 << 32) - (1 << 16), 0, 0, 0, 0, 1 << 30]
    data[start : start + 36] = b"".join(value.to_bytes(4, "big") for value in matrix)
    path.write_bytes(data)


def test_video_of_a_phone_held_upright_is_read_upright(tmp_path):
    path, images = tmp_path / "film.mp4", pictures(2)
    write(path, images)
    rotate_in_header(path)
    (first, _) = open_frames(str(path)).pictures
    assert first.image.shape == (160, 120, 3)
    assert np.median(np.abs(first.image.astype(int) - np.rot90(images[0], -1))) <= 3


def test_images_of_a_folder_are_read_in_order(tmp_path):
    for i, image in enumerate(pictures(3)):
        Image.fromarray(image).save(tmp_path / f"{2 - i}.png")
    frames = open_frames(tmp_path)
    assert frames.count == 3
    read = list(frames.pictures)
    assert [frame.name for frame in read] == ["0.png", "1.png", "2.png"]
    assert np.array_equal(read[2].image, pictures(3)[0])


class FakeCamera:
    """Returns images in OpenCV's order of channels."""

    released = 0

    def __init__(self, index):
        self.images = [] if index else [image[..., ::-1] for image in pictures(3)]

    def isOpened(self):
        return bool(self.images)

    def get(self, _property):
        return 0.0

    def read(self):
        return (True, self.images.pop(0)) if self.images else (False, None)

    def release(self):
        FakeCamera.released += 1


def test_camera_gives_frames_until_it_ends(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    frames, released = open_frames("0"), FakeCamera.released
    assert (frames.count, frames.is_live, frames.frames_per_second) == (None, True, 30)
    assert np.array_equal([frame.image for frame in frames.pictures], pictures(3))
    assert FakeCamera.released == released + 1


def test_missing_camera_is_an_error(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    with pytest.raises(InputError, match=r"^7: no camera"):
        open_frames("7")


def test_file_named_like_a_camera_index_is_read_as_a_file(tmp_path, monkeypatch):
    write(tmp_path / "0.mp4", pictures(2))
    (tmp_path / "0.mp4").rename(tmp_path / "0")
    monkeypatch.chdir(tmp_path)
    assert len(list(open_frames("0").pictures)) == 2


def test_error_names_a_file_that_is_not_a_video(tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "sound.wav").write_bytes(silence(tmp_path / "silence.wav"))
    write(tmp_path / "whole.mp4", pictures(3))
    half = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(half[: len(half) // 2])
    for name, why in {
        "missing.mp4": "no such video",
        "text.mp4": "not a readable video",
        "cut.mp4": "not a readable video",
        "sound.wav": "contains no images",
    }.items():
        with pytest.raises(InputError, match=rf"{name}: {why}"):
            open_frames(str(tmp_path / name))


def silence(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", 8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path.read_bytes()


def test_error_names_an_empty_folder_and_a_broken_image(tmp_path):
    with pytest.raises(InputError, match="contains no image"):
        open_frames(str(tmp_path))
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ImageError, match=r"text\.png"):
        list(open_frames(str(tmp_path)).pictures)


def test_error_names_a_damaged_video(tmp_path, monkeypatch):
    path = tmp_path / "film.mp4"
    write(path, pictures(3))

    def fail(*_arguments, **_options):
        raise av.error.InvalidDataError(1, "damaged")

    monkeypatch.setattr(av.VideoFrame, "to_ndarray", fail, raising=False)
    with pytest.raises(InputError, match=r"film\.mp4: cannot be decoded beyond frame 0"):
        list(open_frames(str(path)).pictures)


def test_error_without_pyav_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "film.mp4").write_text("whatever")
    monkeypatch.setitem(sys.modules, "av", None)
    for use in (
        lambda: open_frames(str(tmp_path / "film.mp4")),
        lambda: write(tmp_path / "out.mp4", pictures(1)),
    ):
        with pytest.raises(InputError, match=r"pip install 'slimsfm\[video\]'"):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_unknown_formats_and_existing_files_are_not_written(tmp_path):
    (tmp_path / "taken.mp4").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=r"film\.gif: videos are written as \.mp4"):
        write(tmp_path / "film.gif", pictures(1))
    with pytest.raises(OutputError, match="exists already"):
        write(tmp_path / "taken.mp4", pictures(1))
    assert contents(tmp_path) == before
    write(tmp_path / "taken.mp4", pictures(1), overwrite=True)
    assert len(list(open_frames(str(tmp_path / "taken.mp4")).pictures)) == 1


def test_failed_video_leaves_no_file(tmp_path):
    def images():
        yield pictures(1)[0]
        raise KeyError("out of film")

    with pytest.raises(KeyError):
        write(tmp_path / "film.mp4", images())
    assert list(tmp_path.iterdir()) == []


def test_equal_images_give_equal_bytes(tmp_path):
    for name in ("a.mp4", "b.mp4"):
        write(tmp_path / name, pictures())
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
