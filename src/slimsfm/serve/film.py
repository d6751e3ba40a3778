"""A film of a rendered object, for the page of who has no object to point a camera at."""

from concurrent.futures import Executor
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from slimsfm.arrays import Image
from slimsfm.progress import ProgressBar, silent
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.scene import (
    Take,
    elsewhere,
    eyes,
    look_at,
    phone_camera,
    textured_object,
    viewing_distance,
)
from slimsfm.tracking.video import write_video

FRAMES, FRAMES_PER_SECOND = 96, 12

_WIDTH, _HEIGHT, _SEED = 640, 480, 0
_SWING_DEG, _HEIGHT_DEG, _NOD_DEG = 45.0, 38.0, 8.0


def write_film(
    path: Path,
    name: str,
    *,
    overwrite: bool = False,
    progress: ProgressBar = silent,
    executor: Executor | None = None,
) -> None:
    """Render a hand-held walk there and back around an object among clutter, which can be played in a loop.

    Args:
        path: Video to write.
        name: A key of `OBJECTS`.
        overwrite: Whether to replace an existing video.
        progress: Progress callback, called once per frame.
        executor: Renders frames in parallel; None renders them here.

    Raises:
        OutputError: The video exists and `overwrite` is off, or cannot be written.
        InputError: PyAV is not installed.
    """
    frames = range(FRAMES)
    with write_video(path, FRAMES_PER_SECOND, overwrite=overwrite) as write:
        rendered = (executor.map if executor else map)(partial(_frame, name), frames)
        for _ in progress(frames, "filming"):
            write(next(rendered))


def _frame(name: str, index: int) -> Image:
    return _take(name).frame(index)


@lru_cache(maxsize=1)
def _take(name: str) -> Take:
    mesh, key = textured_object(name, _SEED), (_SEED, sorted(OBJECTS).index(name), 3)
    turn = 2 * np.pi * np.arange(FRAMES) / FRAMES
    azimuths = np.radians(_SWING_DEG) * np.sin(turn) + 0.5
    elevations = np.radians(_HEIGHT_DEG + _NOD_DEG * np.sin(2 * turn))
    radii = 1.35 * viewing_distance(mesh) * (1 + 0.1 * np.sin(turn + 1))
    places = eyes(azimuths, elevations, radii)
    return Take(
        scene=elsewhere(np.random.default_rng(key), mesh),
        camera=phone_camera(_WIDTH, _HEIGHT, 0.02),
        cam_from_object=tuple(look_at(eye, np.zeros(3)) for eye in places),
        seed=key,
    )
