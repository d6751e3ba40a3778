"""Procedural prints: noise, and pages of text, pictures, shapes and bar codes."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image as PilImage
from PIL import ImageDraw, ImageFont

Picture = UInt8[np.ndarray, "_ _ 3"]
"""RGB image; pictures in one signature may differ in size."""

_SYLLABLES = (
    "ka",
    "lo",
    "mi",
    "ren",
    "tos",
    "va",
    "shi",
    "plu",
    "dor",
    "ent",
    "qui",
    "zel",
    "by",
    "gra",
    "fon",
)


def fractal_noise(
    rng: np.random.Generator, height: int, width: int, cells: int = 4, octaves: int = 6
) -> Float32[np.ndarray, "_ _"]:
    """Sum octaves of smoothly interpolated random grids; the result has values in [0, 1].

    Args:
        rng: Random number generator.
        height: Number of rows.
        width: Number of columns.
        cells: Grid cells of the coarsest octave, in both directions.
        octaves: Number of octaves; each has twice the cells and 0.6 times the weight of the previous one.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        side = min(cells * 2**octave, 2 * max(height, width))
        grid = rng.random((side, side), np.float32)
        total += 0.6**octave * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    low, high = float(total.min()), float(total.max())
    return np.asarray((total - low) / (high - low), np.float32)


def tinted_noise(
    rng: np.random.Generator,
    height: int,
    width: int,
    color: tuple[int, int, int],
    contrast: float,
    cells: int = 3,
) -> Picture:
    """One color whose brightness varies with noise; `contrast` 0 gives the plain color."""
    brightness = 1 + contrast * (fractal_noise(rng, height, width, cells, octaves=4) - 0.5)
    return np.clip(brightness[..., None] * np.array(color), 0, 255).astype(np.uint8)


def picture(rng: np.random.Generator, height: int, width: int) -> Picture:
    """An abstract photo: noise of many octaves, in colors of a random palette."""
    palette = rng.uniform(0, 255, (6, 1)) + rng.uniform(-70, 70, (6, 3))
    position = fractal_noise(rng, height, width) * (len(palette) - 1)
    channels = [np.interp(position, np.arange(len(palette)), palette[:, k]) for k in range(3)]
    return np.clip(np.stack(channels, axis=2), 0, 255).astype(np.uint8)


def page(rng: np.random.Generator, height: int, width: int, *, cell: int = 160) -> Picture:
    """A printed page of cells of about `cell` pixels, each with one kind of print."""
    sheet = PilImage.new("RGB", (width, height), _color(rng, 190, 256))
    for left, top, right, bottom in _cells(rng, (0, 0, width, height), cell):
        fill = _FILLS[rng.integers(len(_FILLS))]
        sheet.paste(fill(rng, bottom - top, right - left), (left, top))
    return np.asarray(sheet)


def stamp(image: Picture, print_: Picture, left: int, top: int) -> Picture:
    """Copy `image` and paste `print_` at a position."""
    result = image.copy()
    result[top : top + print_.shape[0], left : left + print_.shape[1]] = print_
    return result


def label(rng: np.random.Generator, height: int, width: int) -> Picture:
    """A word in large letters on a dark background."""
    return np.asarray(_headline(rng, height, width))


def _cells(
    rng: np.random.Generator, box: tuple[int, int, int, int], cell: int
) -> Iterator[tuple[int, int, int, int]]:
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    if max(width, height) < 2 * cell:
        yield box
    elif width > height:
        middle = left + int(width * rng.uniform(0.35, 0.65))
        yield from _cells(rng, (left, top, middle, bottom), cell)
        yield from _cells(rng, (middle, top, right, bottom), cell)
    else:
        middle = top + int(height * rng.uniform(0.35, 0.65))
        yield from _cells(rng, (left, top, right, middle), cell)
        yield from _cells(rng, (left, middle, right, bottom), cell)


def _color(rng: np.random.Generator, low: int, high: int) -> tuple[int, int, int]:
    red, green, blue = rng.integers(low, high, 3).tolist()
    return red, green, blue


def _word(rng: np.random.Generator) -> str:
    return "".join(rng.choice(_SYLLABLES, rng.integers(1, 4)))


def _headline(rng: np.random.Generator, height: int, width: int) -> PilImage.Image:
    cell = PilImage.new("RGB", (width, height), _color(rng, 0, 130))
    draw = ImageDraw.Draw(cell)
    for k in range(2):
        font = ImageFont.load_default(size=0.42 * height)
        draw.text((0.04 * width, 0.48 * k * height), _word(rng).upper(), _color(rng, 170, 256), font)
    return cell


def _paragraph(rng: np.random.Generator, height: int, width: int) -> PilImage.Image:
    cell = PilImage.new("RGB", (width, height), _color(rng, 200, 256))
    draw, ink, step = ImageDraw.Draw(cell), _color(rng, 0, 90), int(rng.integers(15, 27))
    font = ImageFont.load_default(size=0.85 * step)
    for top in range(4, height - step, step):
        draw.text((6, top), " ".join(_word(rng) for _ in range(1 + width // (2 * step))), ink, font)
    return cell


def _photo(rng: np.random.Generator, height: int, width: int) -> PilImage.Image:
    return PilImage.fromarray(picture(rng, height, width))


def _shapes(rng: np.random.Generator, height: int, width: int) -> PilImage.Image:
    cell = PilImage.new("RGB", (width, height), _color(rng, 60, 256))
    draw = ImageDraw.Draw(cell)
    for _ in range(14):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        radius = rng.uniform(0.04, 0.22) * min(width, height)
        sides, turn = int(rng.choice([3, 4, 5, 6, 24])), float(rng.uniform(0, 360))
        draw.regular_polygon((x, y, radius), sides, turn, _color(rng, 0, 256), _color(rng, 0, 256))
    return cell


def _bar_code(rng: np.random.Generator, height: int, width: int) -> PilImage.Image:
    bars = np.repeat(rng.integers(0, 2, width // 5 + 1), 5)[:width]
    rows = np.where(np.arange(height)[:, None] < 0.75 * height, bars[None], 1)
    cell = PilImage.fromarray(np.repeat((rows[..., None] * 255).astype(np.uint8), 3, axis=2))
    digits = "".join(map(str, rng.integers(0, 10, 12)))
    font = ImageFont.load_default(size=0.16 * height)
    ImageDraw.Draw(cell).text((0.05 * width, 0.78 * height), digits, (0, 0, 0), font)
    return cell


_FILLS = (_headline, _paragraph, _paragraph, _photo, _photo, _shapes, _shapes, _bar_code)
