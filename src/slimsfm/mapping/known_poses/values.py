"""Values of files of poses: matrices, poses and cameras; every error names the file.

Intrinsic matrices in files follow OpenCV, where the center of the top-left pixel is at (0, 0). So COLMAP's cx
is the value in the file plus 0.5; `pinhole_camera` adds it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm import files
from slimsfm.errors import InputError
from slimsfm.files import contents_of
from slimsfm.lenses import camera_fault

PIXEL_CENTER = 0.5
"""Both coordinates of the center of the top-left pixel in COLMAP's convention."""


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


def read_text(path: Path) -> str:
    """Read a text file.

    Raises:
        InputError: The file is missing or not text.
    """
    with contents_of(path, "cannot be read as text"):
        return files.read_text(path)


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
