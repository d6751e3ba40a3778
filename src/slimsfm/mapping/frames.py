"""Choose the frames of a video that a map is built from: sharp ones that show something new.

A video is read as a stream; one picture is kept in memory while the frames around it are compared with it.
"""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import VideoError
from slimsfm.film import film_pictures, open_film
from slimsfm.progress import ProgressBar, counted, silent

FRAMES_PER_SECOND = 2.0
"""Frames of a second of motion: more of them show the same and only cost time."""

_LONGER_PX = 640  # side of the image in which sharpness and motion are measured
_NEAREST, _FARTHEST = 0.5, 1.5  # frame intervals from one candidate to the next
_OFF_CENTER = 0.3  # by which the sharpness of a candidate counts less at either end of these
_NEW = 0.02  # of the longer side, median motion since the last frame that was kept
_CORNERS, _FEWEST_CORNERS = 300, 10
_FOLLOWED = 0.5  # share of the corners; if fewer are found again, the picture is another one
_RATE = 30.0  # frames per second where the file does not say


@dataclass(frozen=True, kw_only=True)
class ChosenFrames:
    """The frames of a video that were written to a folder."""

    seconds: dict[str, float]
    """When each is shown, by the name of its file, in order."""

    num_read: int
    """Number of frames of the video that were read."""

    ended_early: str = ""
    """Why the video was not read to its end; empty if it was."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    index: int
    seconds: float
    image: Image
    gray: GrayImage
    score: float


def extract_frames(
    video: str | Path,
    folder: str | Path,
    *,
    fps: float | int = FRAMES_PER_SECOND,
    strict: bool = False,
    progress: ProgressBar = silent,
) -> ChosenFrames:
    """Write the frames of a video that are sharp and new to a folder, as 000123.png, by their number.

    From one candidate to the next it is half to one and a half intervals, by the times of the file. Among
    these frames the candidate is the sharpest, by the variance of the Laplacian, and rather one in the
    middle. It is kept if corners moved by 2 % of the longer side since the last frame that was kept, in the
    median, so that a camera that stands still gives one frame. Frames are as a player shows them: upright, in
    square pixels.

    Args:
        video: A file that ffmpeg reads.
        folder: Where frames are written; created if it does not exist.
        fps: Frames per second of motion.
        strict: Raise the error of a video that cannot be read to its end.
        progress: Progress callback.

    Raises:
        InputError: The file does not exist, is no video or PyAV is not installed.
        VideoError: With `strict`, the video cannot be read to its end.
    """
    if fps <= 0:
        raise ValueError(f"fps must be positive, got {fps}")
    folder = Path(folder)
    pictures = _Pictures(Path(video), strict=strict, progress=progress)
    seconds: dict[str, float] = {}
    last: GrayImage | None = None
    for one in _candidates(pictures.read(), fps):
        if last is None or _is_new(last, one.gray):
            last, name = one.gray, f"{one.index:06d}.png"
            folder.mkdir(parents=True, exist_ok=True)
            PillowImage.fromarray(one.image).save(folder / name, compress_level=1)
            seconds[name] = one.seconds
    return ChosenFrames(seconds=seconds, num_read=pictures.num_read, ended_early=pictures.ended_early)


class _Pictures:
    """Reads a video with the times of its frames, and remembers how far it got."""

    def __init__(self, video: Path, *, strict: bool, progress: ProgressBar) -> None:
        self.num_read, self.ended_early = 0, ""
        self._video, self._strict, self._progress = video, strict, progress

    def read(self) -> Iterator[tuple[int, float, Image]]:
        container, stream = open_film(self._video)
        rate, total = float(stream.average_rate or _RATE), stream.frames or 1
        label = f"choose frames of {self._video.name}"
        with (
            closing(film_pictures(self._video, container, stream)) as pictures,
            counted(self._progress, total, label) as advance_to,
        ):
            try:
                for index, (image, seconds) in enumerate(pictures):
                    self.num_read = index + 1
                    yield index, index / rate if seconds is None else seconds, image
                    advance_to(min(index + 1, total))
            except VideoError as error:
                if self._strict:
                    raise
                self.ended_early = str(error)
            advance_to(total)


def _candidates(pictures: Iterator[tuple[int, float, Image]], fps: float | int) -> Iterator[_Candidate]:
    """The sharpest frame of each window; a window starts half an interval after the last candidate."""
    start = end = best = None
    for index, seconds, image in pictures:
        if start is None or end is None:
            start, end = seconds, seconds + (_FARTHEST - _NEAREST) / fps
        if best is not None and seconds > end:
            yield best
            start, end, best = best.seconds + _NEAREST / fps, best.seconds + _FARTHEST / fps, None
        if seconds < start:
            continue
        gray = _gray(image)
        off_center = min(1.0, abs(2 * (seconds - start) / (end - start) - 1))
        score = float(cv2.Laplacian(gray, cv2.CV_32F).var()) * (1 - _OFF_CENTER * off_center)
        if best is None or score > best.score:
            best = _Candidate(index=index, seconds=seconds, image=image, gray=gray, score=score)
    if best is not None:
        yield best


def _gray(image: Image) -> GrayImage:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = _LONGER_PX / max(gray.shape)
    if factor < 1:
        size = max(1, round(gray.shape[1] * factor)), max(1, round(gray.shape[0] * factor))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return np.asarray(gray, np.uint8)


def _is_new(last: GrayImage, gray: GrayImage) -> bool:
    """Whether corners of the last frame moved, or are gone."""
    corners = _corners(last)
    if len(corners) < _FEWEST_CORNERS:
        return len(_corners(gray)) >= _FEWEST_CORNERS
    there, found, _ = cv2.calcOpticalFlowPyrLK(last, gray, corners, corners.copy(), maxLevel=5)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(gray, last, there, there.copy(), maxLevel=5)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < 1.0
    followed = (found[:, 0] == 1) & (found_back[:, 0] == 1) & returned
    if followed.mean() < _FOLLOWED:
        return True
    moved = np.linalg.norm(there - corners, axis=2)[followed, 0]
    return float(np.median(moved)) >= _NEW * max(gray.shape)


def _corners(gray: GrayImage) -> np.ndarray:
    found = cv2.goodFeaturesToTrack(gray, _CORNERS, 0.01, 8)
    return np.zeros((0, 1, 2), np.float32) if found is None else found
