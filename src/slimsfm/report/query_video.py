"""All queries of an object one after the other, with the object's box drawn in: as images and as a video."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage

from slimsfm.arrays import Image
from slimsfm.evaluation.results import ObjectResult, Outcomes
from slimsfm.files import replacing
from slimsfm.report.formatting import percent_of_d
from slimsfm.report.frames import QueryFrame, draw_frame

MAX_SIZE = 720
"""Longer side of a query image; larger ones are scaled down."""

FRAMES_PER_SECOND = 5.0
"""Of the video."""

ReadPhoto = Callable[[Path], Image | None]
"""Reads a photo; None where it is not there any more."""

_JPEG = {"quality": 88, "subsampling": 0}  # thin lines keep their colours
_STRIP = 0.055  # height of the caption, over that of the image
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FONT_PX = 22  # height of its capitals at scale 1


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnQuery:
    """A query with the object's box, the true one in green and the estimated in red."""

    name: str
    """Its file's name without suffix, with its number before it where several have the same."""

    image: Image
    """The image."""

    caption: str
    """Which of how many it is, and how far its pose is off."""


def drawn_queries(result: ObjectResult, outcomes: Outcomes, read: ReadPhoto) -> Iterator[DrawnQuery]:
    """Draw the queries of an object one by one; those whose photo is gone are left out.

    Args:
        result: The object.
        outcomes: What became of its queries.
        read: Reads a photo.
    """
    names = _names([query.path.stem for query in result.queries])
    for i, (query, name) in enumerate(zip(result.queries, names, strict=True)):
        photo = read(query.path)
        if photo is None:
            continue
        verdict = percent_of_d(outcomes.error[i])
        frame = QueryFrame(
            image=photo,
            camera=query.camera,
            estimated_cam_from_world=outcomes.cam_from_world[i],
            true_cam_from_world=query.cam_from_world,
            label=name,
            verdict=verdict,
        )
        caption = f"{i + 1}/{len(names)}  {verdict}"
        yield DrawnQuery(name=name, image=draw_frame(frame, result.box, MAX_SIZE), caption=caption)


def _names(stems: Sequence[str]) -> list[str]:
    if len(set(stems)) == len(stems):
        return list(stems)
    return [f"{i:04d}-{stem}" for i, stem in enumerate(stems)]


def save_jpeg(image: Image, path: Path, *, overwrite: bool) -> None:
    """Write an image.

    Raises:
        OutputError: The file exists and `overwrite` is off, or cannot be written.
    """
    with replacing(path, overwrite=overwrite) as partial:
        PillowImage.fromarray(image).save(partial, "JPEG", **_JPEG)


def film_frame(drawn: DrawnQuery, height: int, width: int) -> Image:
    """A frame of a video: the image in the middle of this size, shrunk if need be, its caption below left."""
    frame = np.zeros((height, width, 3), np.uint8)
    own_height, own_width = drawn.image.shape[:2]
    scale = min(height / own_height, width / own_width, 1.0)
    size = max(1, round(own_width * scale)), max(1, round(own_height * scale))
    x, y = (width - size[0]) // 2, (height - size[1]) // 2
    frame[y : y + size[1], x : x + size[0]] = cv2.resize(drawn.image, size, interpolation=cv2.INTER_AREA)
    strip = max(14, round(_STRIP * height))
    frame[-strip:] = frame[-strip:] // 3
    place = (strip // 2, height - strip // 4)
    cv2.putText(frame, drawn.caption, place, _FONT, 0.6 * strip / _FONT_PX, (255, 255, 255), 1, cv2.LINE_AA)
    return frame
