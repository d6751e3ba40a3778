"""Shared helpers of the data set readers: they check each file, and every error names the file.

Those of matrices, which files of poses share, are in `mapping.known_poses.values`.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image as PilImage

from slimsfm import files
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import stored_size
from slimsfm.files import contents_of
from slimsfm.photos import Orientation, exif_orientation, opened_image

_DAMAGED_IMAGE = (OSError, ValueError, SyntaxError, PilImage.DecompressionBombError)


def folders(directory: Path) -> list[Path]:
    """Visible folders, sorted by the numbers in their names, so that box-10 comes after box-2.

    Raises:
        InputError: The directory does not exist.
    """
    if not directory.is_dir():
        raise InputError(f"{directory} is not a folder: check the path")
    found = [path for path in directory.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(
        found, key=lambda path: [(int(d or -1), text) for d, text in re.findall(r"(\d+)|(\D+)", path.name)]
    )


def check_frame_step(frame_step: int) -> None:
    """Check a step between frames.

    Raises:
        ValueError: The step is below 1.
    """
    if frame_step < 1:
        raise ValueError(f"frame_step must be at least 1, got {frame_step}")


def check_object_name(name: str, names: Sequence[str], path: Path) -> None:
    """Check that the data set has an object of this name.

    Raises:
        InputError: The name is not in `names`.
    """
    if name not in names:
        raise InputError(f"{path} has no object {name!r}; it has {', '.join(names)}")


def check_paired(frames: Mapping[int, Path], others: Mapping[int, Path], what: str, hint: str = "") -> None:
    """Check that frames and other files, such as poses, have the same numbers.

    Args:
        frames: Image files by number.
        others: The other files by number.
        what: What one of the other files holds, such as "pose".
        hint: Added to the message.

    Raises:
        InputError: A file has no partner; the message names the first one.
    """
    if alone := sorted(frames.keys() ^ others.keys()):
        is_frame = alone[0] in frames
        path = (frames if is_frame else others)[alone[0]]
        missing = what if is_frame else "frame"
        folder = next(iter((others if is_frame else frames).values())).parent.name
        raise InputError(
            f"{path} has no {missing} in {folder}: add it or remove this file "
            f"({len(frames)} frames, {len(others)} of {what}){hint}"
        )


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        InputError: The file is missing or damaged, or does not hold a JSON object.
    """
    with contents_of(path, "cannot be read as JSON"):
        data = files.read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object, got a {type(data).__name__}")
    return data


def image_size(path: Path, orientation: Orientation = "upright") -> tuple[int, int]:
    """Width and height of an image, upright or as it is stored; reads only the header if possible.

    Raises:
        ImageError: The file is missing or not an image.
    """
    try:
        with opened_image(path) as image:
            if image.format == "PNG" and "exif" not in image.info:
                return image.size  # EXIF after the pixels would require decoding them
            width, height = stored_size(image)
            is_turned = orientation == "upright" and exif_orientation(image) >= 5
            return (height, width) if is_turned else (width, height)
    except FileNotFoundError as error:
        raise ImageError(f"{path} cannot be read as an image: there is no such file") from error
    except _DAMAGED_IMAGE as error:
        raise ImageError(f"{path} cannot be read as an image: {error}") from error


def equal_size(paths: Sequence[Path]) -> tuple[int, int]:
    """The common size of images that share a camera.

    Raises:
        ImageError: A file is missing, not an image or of another size than the first.
    """
    size = image_size(paths[0])
    for path in paths[1:]:
        if image_size(path) != size:
            raise ImageError(
                f"{path} has {'x'.join(map(str, image_size(path)))} pixels, but {paths[0].name} has "
                f"{'x'.join(map(str, size))}: all frames of a video must have the same size"
            )
    return size
