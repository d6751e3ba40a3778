"""Films whose frames carry their number as a bar code, and measuring what a page draws over them."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float64
from PIL import Image as PilImage

from slimsfm.arrays import Image, Points2D, Points3D
from slimsfm.geometry import project

if TYPE_CHECKING:
    from browser import Page

BITS = 10
CELLS = 2 + 2 * BITS  # white, black, then each bit and its opposite
BOX_COLOR = (23, 242, 179)
"""Color of the box that the page draws when it is sure, RGB: `COLORS.found` in objects.js."""

_SPECK = 0.1  # largest area of a speck of this color, over that of a part of the box
_SIMILAR = 70  # largest distance of a color to that of the box


@dataclass(frozen=True, eq=False, kw_only=True)
class NumberedFilm:
    """A film that is played in a loop as a camera."""

    frames: Iterable[Image]
    camera: pycolmap.Camera
    cam_from_world: Sequence[pycolmap.Rigid3d]
    corners: Points3D
    """Points of a convex object; the hull of their pixels is its outline."""

    def outline(self, index: int) -> Points2D | None:
        """Pixels of the object's hull in a frame; None where a corner is behind the camera."""
        pixels = project(self.corners, self.cam_from_world[index], self.camera)
        if not np.all(np.isfinite(pixels)):
            return None
        return cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)

    def visible_share(self, index: int) -> float:
        """Share of the outline's area that is inside the picture."""
        outline = self.outline(index)
        if outline is None:
            return 0.0
        right, bottom = self.camera.width, self.camera.height
        frame = np.array([(0, 0), (right, 0), (right, bottom), (0, bottom)], np.float32)
        hull = outline.astype(np.float32)
        inside, _ = cv2.intersectConvexConvex(hull, frame)
        return float(inside / cv2.contourArea(hull))

    def write(self, path: Path, frames_per_second: int) -> None:
        """Write the film as uncompressed y4m, with the numbers in its frames."""
        size = f"W{self.camera.width} H{self.camera.height}"
        with path.open("wb") as file:
            file.write(f"YUV4MPEG2 {size} F{frames_per_second}:1 Ip A1:1 C420jpeg\n".encode())
            for index, frame in enumerate(self.frames):
                yuv = cv2.cvtColor(with_number(frame, index), cv2.COLOR_RGB2YUV_I420)
                file.write(b"FRAME\n" + yuv.tobytes())


def cell_px(width: int) -> int:
    """Side of a cell of the bar code in a picture of this width."""
    return width // 40


def with_number(image: Image, number: int) -> Image:
    """The image with a number as bars at its bottom left."""
    side, marked = cell_px(image.shape[1]), image.copy()
    for place, bit in enumerate(number_bits(number)):
        marked[-side:, place * side : (place + 1) * side] = 255 * bit
    return marked


def number_bits(number: int) -> list[int]:
    """The cells of a number: 1 is white."""
    bits = [number >> place & 1 for place in range(BITS)]
    return [1, 0, *(cell for bit in bits for cell in (bit, 1 - bit))]


def read_number(picture: Image) -> int | None:
    """The number in a picture of any size; None where there is none, or two pictures are mixed."""
    height, width = picture.shape[:2]
    side = width / 40
    middles = ((np.arange(CELLS) + 0.5) * side).astype(int)
    cells = picture[int(height - side / 2), middles].mean(axis=1) > 127
    if not cells[0] or cells[1] or np.any(cells[2::2] == cells[3::2]):
        return None
    return int(sum(int(bit) << place for place, bit in enumerate(cells[2::2])))


def drawn_outline(picture: Image) -> Points2D | None:
    """The hull of the pixels that have the color of the page's box; None where there are hardly any."""
    away = np.linalg.norm(picture.astype(float) - BOX_COLOR, axis=2)
    is_box = (away < _SIMILAR).astype(np.uint8)
    joined = cv2.dilate(is_box, np.ones((7, 7), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    sizes = stats[1:, cv2.CC_STAT_AREA]
    if not len(sizes):
        return None
    large = 1 + np.flatnonzero(sizes > _SPECK * sizes.max())  # not specks of the scene
    y, x = np.nonzero((is_box > 0) & np.isin(labels, large))
    if len(x) < 50:
        return None
    return cv2.convexHull(np.stack([x, y], axis=1).astype(np.float32))[:, 0] + 0.5


def shown(page: Page) -> tuple[Image, str]:
    """The pixels of the page's canvas at some moment, and the page's state."""
    data, state = shown_as_png(page)
    return decoded(data), state


def shown_as_png(page: Page) -> tuple[str, str]:
    """The page's canvas at some moment as a PNG in a data URL, and the page's state."""
    return tuple(page.run("[document.getElementById('view').toDataURL(), document.body.dataset.state]"))


def decoded(data: str) -> Image:
    """The RGB pixels of an image in a data URL."""
    with PilImage.open(BytesIO(base64.b64decode(data.partition(",")[2]))) as image:
        return np.array(image.convert("RGB"))


def picture_in(canvas: Image, camera: pycolmap.Camera) -> Image:
    """The part of a canvas that has the camera's picture: as large as fits, in the middle."""
    height, width = canvas.shape[:2]
    factor = min(width / camera.width, height / camera.height)
    w, h = round(camera.width * factor), round(camera.height * factor)
    top = height - (height - h) // 2 - h  # WebGL counts rows from below
    left = (width - w) // 2
    return np.ascontiguousarray(canvas[top : top + h, left : left + w, :3])


def filled_polygon(outline: Float64[np.ndarray, "n 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels in a convex polygon."""
    canvas = np.zeros(shape, np.uint8)
    return cv2.fillConvexPoly(canvas, np.rint(16 * (outline - 0.5)).astype(np.int32), 1, shift=4) > 0


def overlap(film: NumberedFilm, picture: Image) -> tuple[int, float] | None:
    """The number of the frame that a picture shows, and how the true and the drawn outline overlap.

    Args:
        film: The film.
        picture: The page's picture, without what is around it, in any size.

    Returns:
        The overlap is intersection over union; 0 where nothing is drawn. None where there is no number.
    """
    number = read_number(picture)
    true = None if number is None else film.outline(number)
    if number is None or true is None:
        return None
    drawn = drawn_outline(picture)
    if drawn is None:
        return number, 0.0
    shape = picture.shape[:2]
    masks = [filled_polygon(true * shape[1] / film.camera.width, shape), filled_polygon(drawn, shape)]
    return number, float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


KEEP_PIXELS = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, { ...options, preserveDrawingBuffer: true });
};
"""
"""Script after which the pixels of canvases can be read at any time."""

RECORD = """
(() => {
  const cells = document.createElement("canvas");
  const [bits, video] = [BITS, document.getElementById("video")];
  cells.width = 2 + 2 * bits;
  cells.height = 1;
  const context = cells.getContext("2d", { willReadFrequently: true });
  window.record = [];
  const step = () => {
    requestAnimationFrame(step);
    const side = video.videoWidth / 40;
    if (!side) return;
    context.drawImage(video, 0, video.videoHeight - side, side * cells.width, side, 0, 0, cells.width, 1);
    const data = context.getImageData(0, 0, cells.width, 1).data;
    let number = 0;
    for (let i = 0; i < bits; i++) number |= (data[4 * (2 + 2 * i)] > 127 ? 1 : 0) << i;
    record.push([performance.now(), number, document.body.dataset.state]);
  };
  step();
})()
""".replace("BITS", str(BITS))
"""Script that notes time, number of the camera's frame and state of the page, frame by frame, in `record`."""


@dataclass(frozen=True, kw_only=True)
class Return:
    """The object came into sight again."""

    was_lost: bool
    """Whether the page said so while the object was out of sight."""

    seconds: float
    """From the first frame with the object to the page's finding it; infinite if it did not."""


def returns(film: NumberedFilm, record: Iterable[tuple[float, int, str]], least: float = 0.8) -> list[Return]:
    """Each return of the object into sight, from a record of `RECORD`.

    Args:
        film: The film.
        record: Milliseconds, number of the frame and state.
        least: Visible share of the object from which it counts as in sight; below a tenth of it, it is away.
    """
    shares = [film.visible_share(index) for index in range(len(film.cam_from_world))]
    found: list[Return] = []
    away, lost, since = False, False, None
    for time, number, state in record:
        share = shares[number] if number < len(shares) else 0.0
        if since is not None and state in ("found", "unsure"):
            found.append(Return(was_lost=lost, seconds=(time - since) / 1000))
            away, lost, since = False, False, None
        if share < least / 10:
            if since is not None:
                found.append(Return(was_lost=lost, seconds=float("inf")))
                lost = since = None
            away, lost = True, bool(lost) or state == "lost"
        elif share >= least and away and since is None:
            since = time
    return found
