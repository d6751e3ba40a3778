"""Shared helpers of the data set readers: they check each file, and every error names the file.

Intrinsic matrices in files follow OpenCV, where the center of the top-left pixel is at (0, 0). So COLMAP's cx
is the value in the file plus 0.5; `pinhole_camera` adds it for all data sets.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64
from PIL import Image as PilImage

from slimsfm import files
from slimsfm.errors import ImageError, InputError
from slimsfm.exif import stored_size
from slimsfm.files import contents_of
from slimsfm.lenses import camera_fault
from slimsfm.photos import Orientation, exif_orientation, opened_image

PIXEL_CENTER = 0.5
"""Both coordinates of the center of the top-left pixel in COLMAP's convention."""

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


def numbered(directory: Path, ending: str) -> dict[int, Path]:
    """Files whose name is a number and an ending, by that number, ascending.

    Raises:
        InputError: The directory holds no such file.
    """
    stems = ((path, path.name.removesuffix(ending)) for path in directory.glob(f"*{ending}"))
    paths = {int(stem): path for path, stem in stems if stem.isdecimal()}
    if not paths:
        raise InputError(f"{directory} holds no file 0{ending}, 1{ending}, ...: one per frame is required")
    return dict(sorted(paths.items()))


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


def read_text(path: Path) -> str:
    """Read a text file.

    Raises:
        InputError: The file is missing or not text.
    """
    with contents_of(path, "cannot be read as text"):
        return files.read_text(path)


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


def read_matrix(path: Path, rows: Sequence[int], columns: int) -> Float64[np.ndarray, "rows columns"]:
    """Read a matrix from a text file with one row per line.

    Args:
        path: A text file.
        rows: Accepted numbers of rows.
        columns: Number of columns.

    Raises:
        InputError: The file is missing, has another shape or a value that is not finite.
    """
    text, shape = read_text(path), f"{' or '.join(map(str, rows))} rows of {columns}"
    try:
        matrix = np.array(
            [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
        )
    except ValueError as error:
        raise InputError(f"{path} must hold {shape} numbers: {error}") from error
    if matrix.shape not in [(count, columns) for count in rows] or not np.all(np.isfinite(matrix)):
        raise InputError(f"{path} must hold {shape} finite numbers, got shape {matrix.shape}")
    return matrix


def read_pose(path: Path, rows: Sequence[int] = (4,)) -> pycolmap.Rigid3d:
    """Read a pose: a 3x4 matrix of rotation and translation, or 4x4 with the last row 0 0 0 1.

    Raises:
        InputError: The file is missing or does not hold a pose.
    """
    return rigid(read_matrix(path, rows, 4), path)


def rigid(matrix: Float64[np.ndarray, "rows 4"], source: Path | str) -> pycolmap.Rigid3d:
    """The rigid transform of a 3x4 or 4x4 matrix.

    Raises:
        InputError: The matrix is not a rigid transform; the message names the source.
    """
    rotation = matrix[:3, :3]
    turns = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not (turns and np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6)):
        raise InputError(
            f"{source} is not a pose: its first three columns must be a rotation and its last row 0 0 0 1"
        )
    turned = pycolmap.Rotation3d(rotation)
    turned.normalize()  # values in files are rounded
    return pycolmap.Rigid3d(turned, matrix[:3, 3])


def pinhole_camera(
    intrinsics: Float64[np.ndarray, "3 3"], size: tuple[int, int], source: Path | str
) -> pycolmap.Camera:
    """Convert an intrinsic matrix in OpenCV's convention to a camera in COLMAP's.

    Args:
        intrinsics: The matrix, in pixels.
        size: Width and height of the image.
        source: Origin of the matrix, for messages.

    Raises:
        InputError: The matrix does not describe a pinhole camera, or an impossible one; the message names the
            source.
    """
    (fx, skew, cx), (zero, fy, cy), last = intrinsics
    whole = np.all(np.isfinite(intrinsics)) and fx > 0 and fy > 0
    if not (whole and abs(skew) < 1e-6 * fx and zero == 0 and np.array_equal(last, (0, 0, 1))):
        raise InputError(
            f"{source} must have positive focal lengths, a finite principal point and no skew, "
            f"got {' '.join(f'{value:g}' for value in intrinsics.ravel())}"
        )
    params = [fx, fy, cx + PIXEL_CENTER, cy + PIXEL_CENTER]
    camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=params)
    if fault := camera_fault(camera):
        raise InputError(f"{source}: the camera is impossible: {fault}; correct the matrix")
    return camera


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
