"""Read text models, with what pycolmap's own reader does not know.

These are a byte order mark, which editors on Windows write, keypoints that are not a number, which COLMAP's
undistorter writes, and spaces in the names of images.
"""

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.files import read_bytes, read_text, working_folder
from slimsfm.mapping.binary import MODEL_PARTS

_NO_NUMBER = re.compile(r"[-+]?(nan|inf(inity)?)(?=\s|$)", re.IGNORECASE)
_FAR = 1e30  # stands in for what is not a number


def read_text_model(path: Path) -> pycolmap.Reconstruction:
    """Read a text model; a damaged one raises any of pycolmap's errors, or ValueError."""
    files = [file for part in MODEL_PARTS if (file := path / f"{part}.txt").is_file()]
    lines = read_text(path / "images.txt").split("\n")
    odd = {row for row in _keypoint_rows(lines) if "n" in "".join(lines[row : row + 1]).lower()}
    model = pycolmap.Reconstruction()
    if not odd and not any(_starts_with_mark(file) for file in files):
        model.read_text(path)
    else:
        for row in odd:
            lines[row] = _NO_NUMBER.sub(str(_FAR), lines[row])
        with working_folder() as folder:
            for file in files:
                (folder / file.name).write_bytes(read_bytes(file).removeprefix(codecs.BOM_UTF8))
            (folder / "images.txt").write_text("\n".join(lines), "utf-8")
            model.read_text(folder)
    for row in _keypoint_rows(lines):
        words = lines[row - 1].split(maxsplit=9)
        image = model.image(int(words[0]))
        image.name = words[9].strip()
        if row in odd:
            _restore(image)
    return model


def _keypoint_rows(lines: list[str]) -> Iterator[int]:
    """The second line of each image."""
    rows = iter(range(len(lines)))
    for row in rows:
        if lines[row].strip() and not lines[row].strip().startswith("#"):
            yield row + 1
            next(rows, None)


def _starts_with_mark(file: Path) -> bool:
    with file.open("rb") as opened:
        return opened.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8


def _restore(image: pycolmap.Image) -> None:
    for point in image.points2D:
        point.xy = np.where(np.abs(point.xy) < _FAR / 2, point.xy, np.nan)
