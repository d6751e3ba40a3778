"""Localize what a reduced map could not, with the full map that it was made from."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.errors import ImageError, InputError
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.localization.batch import localize_images
from slimsfm.localization.localizer import Localizer
from slimsfm.localization.outcome import Localization, Seconds
from slimsfm.mapping.map import Map
from slimsfm.pose import Gravity
from slimsfm.progress import ProgressBar, silent


def check_same_frame(slim: Map, full: Map) -> None:
    """Check that poses in two maps mean the same.

    Raises:
        InputError: The boxes of the maps differ, so that one was not reduced from the other.
    """
    if not np.allclose(slim.box.corners, full.box.corners, atol=1e-6 * full.box.diagonal):
        raise InputError(
            "full must be the map that the reduced one was made from, but their boxes differ; "
            "reduce the full map again, or leave out full"
        )


def localize_failed(
    full: Localizer,
    found: Mapping[str, Localization],
    images: str | Path,
    *,
    camera: pycolmap.Camera | None = None,
    gravity: Mapping[str, Gravity] | None = None,
    workers: int | None = None,
    progress: ProgressBar = silent,
) -> dict[str, Localization]:
    """Localize images with the full map where the reduced one gave no pose.

    Args:
        full: Localizer of the full map.
        found: What `localize_images` returned for these images with the reduced map.
        images: The folder of the images, or the one image.
        camera: As in `localize_images`.
        gravity: As in `localize_images`.
        workers: As in `localize_images`.
        progress: Progress bar, one step per image without a pose.

    Returns:
        By name, the outcomes of the images without a pose, in order. Their times include those of the reduced
        map. `{**found, **localize_failed(...)}` are the outcomes of all images. Images that were skipped stay
        so, and the outcome of the reduced map stays where the full one does not know the intrinsics.

    Raises:
        InputError: As in `localize_images`.
    """
    folder = Path(images).parent if Path(images).is_file() else Path(images)
    failed = [name for name, one in found.items() if one.pose is None and not one.is_skipped]

    def localize_again(name: str) -> Localization:
        path, down = folder / name, (gravity or {}).get(name)
        given = {} if down is None else {path.name: down}
        try:
            (one,) = localize_images(full, path, camera=camera, gravity=given, workers=1).values()
        except ImageError:
            return found[name]
        return replace(one, seconds=_sum(found[name].seconds, one.seconds))

    run = map_on_threads(localize_again, failed, workers or num_cores())
    return {name: next(run) for name in progress(failed, "localize with the full map")}


def _sum(one: Seconds, other: Seconds) -> Seconds:
    return Seconds(
        extract=one.extract + other.extract, match=one.match + other.match, pose=one.pose + other.pose
    )
