"""Photos with EXIF data: their pixels are stored so that they are upright when turned as EXIF says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, -1),
}
"""Stored pixels of an upright image, by EXIF orientation."""

MIRRORED = (2, 4, 5, 7)
"""EXIF orientations that are no rotations."""


def save_photo(path: Path, upright: np.ndarray, orientation: int = 1, **tags: Any) -> Path:
    """Save an upright image with this EXIF orientation, and with further EXIF data by name."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for name, value in tags.items():
        data = exif if name in ("Make", "Model") else exif.get_ifd(ExifTags.IFD.Exif)
        data[ExifTags.Base[name]] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = np.ascontiguousarray(STORED[orientation](upright))
    Image.fromarray(stored).save(path, exif=exif)
    return path
