import struct
import sys
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from commands import contents
from exif_photos import STORED, save_photo
from slimsfm.errors import ImageError, InputError, OutputError, VideoError
from slimsfm.film import with_square_pixels
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


def set_display_matrix(path, right, down):
    """Write to the header where a player shows a step right and a step down of the stored pixels."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    numbers = [*(value << 16 for value in right), 0, *(value << 16 for value in down), 0, 0, 0, 1 << 30]
    data[start : start + 36] = struct.pack(">9i", *numbers)
    path.write_bytes(data)


@pytest.mark.parametrize("right", [(1, 0), (-1, 0), (0, 1), (0, -1)], ids=str)
@pytest.mark.parametrize("sign", [1, -1], ids=["rotated", "mirrored"])
def test_pictures_are_rotated_and_mirrored_as_the_file_says(tmp_path, right, sign):
    path, stored = tmp_path / "film.mp4", pictures(2)
    stored[:, 60:, :40] = 120  # so that all eight ways differ
    write(path, stored)
    down = -sign * right[1], sign * right[0]
    set_display_matrix(path, right, down)
    (first, _) = open_frames(path).pictures
    rows, columns = np.indices(stored[0].shape[:2])
    x, y = (columns * right[axis] + rows * down[axis] for axis in (0, 1))
    shown = np.zeros_like(stored[0], shape=(np.ptp(y) + 1, np.ptp(x) + 1, 3))
    shown[y - y.min(), x - x.min()] = stored[0]
    assert first.image.shape == shown.shape
    difference = np.abs(first.image.astype(int) - shown)
    assert np.median(difference) <= 3
    assert np.mean(difference > 20) < 0.02


def write_film(path, images, aspect=None, times=None, **options):
    """Write images, which may change their size, as MJPEG or as `codec`."""
    with av.open(str(path), "w") as container:
        add_film(container, images, aspect, times, **options)()


def add_film(container, images, aspect=None, times=None, codec="mjpeg"):
    """Add a film to a file; return the function that writes its frames."""
    stream = container.add_stream(codec, 25)
    stream.height, stream.width = images[0].shape[:2]
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
    if aspect:
        stream.codec_context.sample_aspect_ratio = aspect

    def mux():
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base = Fraction(1, 1000)
            frame.pts = times[index] if times else 40 * index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))

    return mux


@pytest.mark.parametrize(
    ("aspect", "size"),
    [
        (Fraction(4, 3), (120, 213)),
        (Fraction(1, 2), (240, 160)),
        (Fraction(1), (120, 160)),
        (Fraction(9, 2), (120, 160)),
        (Fraction(1, 5), (120, 160)),
    ],
    ids=str,
)
def test_pixels_become_square_unless_their_shape_is_absurd(tmp_path, aspect, size):
    path, stored = tmp_path / "film.mkv", pictures(2)
    write_film(path, stored, aspect, codec="libx264")
    (first, _) = open_frames(path).pictures
    expected = np.asarray(Image.fromarray(stored[0]).resize(size[::-1]), int)
    assert first.image.shape == expected.shape
    assert np.median(np.abs(first.image - expected)) <= 3


def test_square_pixels_keep_where_things_are():
    ramp = np.tile(np.arange(160, dtype=np.uint8)[None, :, None], (4, 1, 3))
    wide = with_square_pixels(ramp, Fraction(3, 2))
    assert wide.shape == (4, 240, 3)
    centers = (np.arange(240) + 0.5) / 1.5 - 0.5  # of the wide pixels, in stored pixels
    assert np.abs(wide[0, 3:-3, 0] - centers[3:-3]).max() <= 0.6


def test_pixels_become_square_before_they_are_rotated(tmp_path):
    path = tmp_path / "film.mp4"
    write_film(path, pictures(2), Fraction(2), codec="libx264")
    set_display_matrix(path, (0, 1), (-1, 0))
    assert [frame.image.shape for frame in open_frames(path).pictures] == 2 * [(320, 120, 3)]


def test_the_best_film_of_a_file_is_read(tmp_path):
    path, large, small = tmp_path / "film.mkv", pictures(30), pictures(3, 60, 80)
    with av.open(str(path), "w") as container:
        films = [add_film(container, one, codec="libx264") for one in (small, large)]
        for index, stream in enumerate(container.streams.video):
            stream.disposition = av.stream.Disposition.default if index else av.stream.Disposition(0)
        for mux in films:
            mux()
    assert {frame.image.shape for frame in open_frames(path).pictures} == {(120, 160, 3)}


def test_a_cover_picture_is_not_a_film(tmp_path):
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as container:
        cover = add_film(container, pictures(1, 300, 300))
        film = add_film(container, pictures(3), codec="libx264")
        container.streams.video[0].disposition = av.stream.Disposition.attached_pic
        film()
        cover()
    assert [frame.image.shape for frame in open_frames(path).pictures] == 3 * [(120, 160, 3)]


def test_frames_have_the_times_of_the_file(tmp_path):
    path, times = tmp_path / "film.mkv", [0, 40, 50, 300, 1000]
    write_film(path, pictures(5), times=times)
    assert [frame.seconds for frame in open_frames(path).pictures] == [time / 1000 for time in times]


def test_images_of_a_folder_have_no_times(tmp_path):
    Image.fromarray(pictures(1)[0]).save(tmp_path / "0.png")
    assert [frame.seconds for frame in open_frames(tmp_path).pictures] == [None]


def read_until_error(path):
    """The frames before a film ends too early, and why it does."""
    read = []
    with pytest.raises(VideoError) as error:
        read.extend(open_frames(path).pictures)  # keeps what came before the error
    return read, str(error.value)


def test_a_change_of_size_ends_a_film_with_the_frames_before(tmp_path):
    path = tmp_path / "film.mjpeg"
    for images in (pictures(3), pictures(2, 240, 320)):
        write_film(tmp_path / "part.mjpeg", images)
        with path.open("ab") as file:
            file.write((tmp_path / "part.mjpeg").read_bytes())
    read, why = read_until_error(path)
    assert [frame.image.shape for frame in read] == 3 * [(120, 160, 3)]
    assert why == f"{path}: ends before frame 3, which has 320x240 pixels; the frames before have 160x120"


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_film_that_is_cut_off_ends_with_the_frames_before(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    noise = list(np.random.default_rng(0).integers(0, 255, (50, 48, 64, 3), np.uint8))
    with av.open(str(path), "w", options={"movflags": "faststart"} if suffix == ".mp4" else {}) as container:
        add_film(container, noise)()
    whole = list(open_frames(path).pictures)
    assert len(whole) == 50
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    read, why = read_until_error(path)
    assert 25 <= len(read) <= 30
    assert all(np.array_equal(a.image, b.image) for a, b in zip(read, whole, strict=False))
    assert why.startswith(f"{path}: is ")
    assert f"frame {len(read) - 1}" in why


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
    read = list(frames.pictures)
    assert np.array_equal([frame.image for frame in read], pictures(3))
    assert 0 == read[0].seconds < read[1].seconds < read[2].seconds
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


def test_error_names_a_video_without_a_whole_frame(tmp_path, monkeypatch):
    path = tmp_path / "film.mp4"
    write(path, pictures(3))

    def fail(*_arguments, **_options):
        raise av.error.InvalidDataError(1, "damaged")

    monkeypatch.setattr(av.VideoFrame, "to_ndarray", fail, raising=False)
    with pytest.raises(InputError, match=r"film\.mp4: no frame can be decoded"):
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
