"""Folders of photos as people bring them, made from good ones: mixtures, brackets, blur, zooms, panoramas.

Each maker takes a folder of photos of one place and one of another place, and yields photos with their names.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from slimsfm.arrays import Image
from slimsfm.image_files import list_images
from slimsfm.photos import read_image

Named = Iterable[tuple[str, Image]]
_EVERY = 2  # photos of a set: half of them make a set as people take it


def mixture(folder: Path, other: Path) -> Named:
    """20 photos of one place and 8 of another in one folder."""
    yield from _some(folder, 20)
    yield from (("other-" + name, image) for name, image in _some(other, 8))


def bracket(folder: Path, _: Path) -> Named:
    """Photos from 5 places, each with 4 exposures, the darkest nearly black."""
    for name, image in _some(folder, 5):
        for stop in (0, 2, 4, -2):
            factor = 2.0**-stop
            yield f"{Path(name).stem}_{stop + 2}.png", np.clip(image * factor, 0, 255).astype(np.uint8)


def blur(folder: Path, _: Path) -> Named:
    """Every third photo is blurred by the motion of the hand."""
    kernel = np.zeros((31, 31), np.float32)
    np.fill_diagonal(kernel, 1 / 31)
    for number, (name, image) in enumerate(_some(folder, 24)):
        yield name, np.asarray(cv2.filter2D(image, -1, kernel), np.uint8) if number % 3 == 0 else image


def zoom(folder: Path, _: Path) -> Named:
    """Every third photo is zoomed 1.5 times; the sizes are equal and EXIF is missing."""
    for number, (name, image) in enumerate(_some(folder, 22)):
        yield name, _zoomed(image, 1.5) if number % 3 == 0 else image


def panorama(folder: Path, _: Path) -> Named:
    """One photo as seen by a camera that turns and does not move."""
    image = next(iter(_some(folder, 1)))[1]
    height, width = image.shape[:2]
    camera = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    generator = np.random.default_rng(0)
    for number in range(15):
        turn, _ = cv2.Rodrigues(np.radians(generator.uniform(-9, 9, 3)))
        warp = camera @ turn @ np.linalg.inv(camera)
        turned = cv2.warpPerspective(image, warp, (width, height))
        inside = turned[height // 6 : -height // 6, width // 6 : -width // 6]
        noise = generator.normal(0, 2, inside.shape)
        yield f"turned{number:02d}.png", np.clip(inside + noise, 0, 255).astype(np.uint8)


def two_places(folder: Path, other: Path) -> Named:
    """12 photos of one place and 10 of another, all of one size."""
    size = next(iter(_some(folder, 1)))[1].shape[1::-1]
    yield from _some(folder, 12)
    for name, image in _some(other, 10):
        yield "other-" + name, np.asarray(cv2.resize(image, size), np.uint8)


def equal(folder: Path, _: Path) -> Named:
    """One photo three times."""
    name, image = next(iter(_some(folder, 1)))
    for number in range(3):
        yield f"{number}-{Path(name).name}", image


def black(folder: Path, _: Path) -> Named:
    """Photos that are nearly black."""
    for name, image in _some(folder, 12):
        yield name, (image // 40).astype(np.uint8)


def _zoomed(image: Image, factor: float) -> Image:
    height, width = image.shape[:2]
    top, left = round(height * (1 - 1 / factor) / 2), round(width * (1 - 1 / factor) / 2)
    return np.asarray(cv2.resize(image[top : height - top, left : width - left], (width, height)), np.uint8)


def _some(folder: Path, count: int) -> Named:
    names = list_images(folder)
    step = max(1, min(_EVERY, len(names) // count))
    for name in names[::step][:count]:
        yield name, read_image(folder / name)


MAKERS: dict[str, Callable[[Path, Path], Named]] = {
    made.__name__: made for made in (mixture, bracket, blur, zoom, panorama, two_places, equal, black)
}
