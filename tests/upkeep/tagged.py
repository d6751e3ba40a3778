"""Photos of printed tags, cast ray by ray through a distorted lens, and maps with their exact poses."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from scenes import camera
from slimsfm.mapping.map import Map
from slimsfm.upkeep.tags import _DICTIONARIES, Family

_PIXELS, _MARGIN, _FINER = 400, 50, 2


@cache
def sheet(number: int, family: Family) -> np.ndarray:
    """A tag with a white margin, an eighth of its side, dark on light gray."""
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[family])
    tag = cv2.aruco.generateImageMarker(dictionary, number, _PIXELS)
    return np.clip(np.pad(tag, _MARGIN, constant_values=255), 30, 225)


@cache
def rays() -> np.ndarray:
    """Directions in the camera of all parts of pixels, row by row."""
    lens = camera()
    y, x = (np.mgrid[: lens.height * _FINER, : lens.width * _FINER] + 0.5) / _FINER
    found = np.asarray(lens.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
    return np.column_stack([found, np.ones(len(found))])


def photograph(
    folder: Path,
    map_: Map,
    names: list[str],
    tags: dict[int, tuple[np.ndarray, float]],
    family: Family = "apriltag-36h11",
) -> Path:
    """Save what cameras of the map see of horizontal tags, given by center and side, that face up."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = camera()
    shape = (lens.height * _FINER, lens.width * _FINER)
    for name in names:
        world_from_cam = map_.images[name].cam_from_world().inverse()
        towards = rays() @ world_from_cam.rotation.matrix().T
        seen = np.full(shape, 140, np.uint8)
        for number, (center, side) in tags.items():
            depth = (center[2] - world_from_cam.translation[2]) / towards[:, 2]
            there = world_from_cam.translation + depth[:, None] * towards - center
            u = (there[:, 0] / side + 0.5) * _PIXELS + _MARGIN - 0.5
            v = (0.5 - there[:, 1] / side) * _PIXELS + _MARGIN - 0.5
            maps = [np.where(depth > 0, one, -1e3).astype(np.float32).reshape(shape) for one in (u, v)]
            cv2.remap(
                sheet(number, family), *maps, cv2.INTER_LINEAR, dst=seen, borderMode=cv2.BORDER_TRANSPARENT
            )
        finer = seen.reshape(lens.height, _FINER, lens.width, _FINER).astype(np.float32)
        gray = np.rint(finer.mean(axis=(1, 3))).astype(np.uint8)
        Image.fromarray(np.repeat(gray[..., None], 3, axis=2)).save(folder / name)
    return folder
