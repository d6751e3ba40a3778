"""The folder of a sequence of OnePose [1]: `datasets.onepose` describes the layout. Its unit is the meter.

References:
    [1] Sun et al., OnePose: One-Shot Object Pose Estimation without CAD Models, CVPR 2022.
"""

import re
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.mapping.known_poses.given import COLMAP, GivenPoses
from slimsfm.mapping.known_poses.values import PIXEL_CENTER, numbered, read_matrix, read_pose, read_text

POSES, CROPS, INTRINSICS = "poses_ba", "intrin_ba", "intrinsics.txt"


def recognizes(path: Path) -> bool:
    """Whether this is such a folder."""
    return (path / POSES).is_dir()


def read(path: Path) -> GivenPoses:
    """Read poses and the intrinsics of full frames or, where there are no full frames, of the crops.

    Raises:
        InputError: A file is missing or damaged.
    """
    poses = {number: read_pose(file) for number, file in numbered(path / POSES, ".txt").items()}
    is_full = (path / "color_full").is_dir() or not (path / CROPS).is_dir()
    folder = path / ("color_full" if is_full else "color")
    if is_full:
        whole = read_intrinsics(path / INTRINSICS)
        matrices = dict.fromkeys(poses, whole)
    else:
        matrices = {
            number: read_matrix(file, (3,), 3) for number, file in numbered(path / CROPS, ".txt").items()
        }
    names = {number: f"{number}.png" for number in poses if number in matrices}
    return GivenPoses(
        source=path,
        key="name",
        cam_from_world={name: poses[number] for number, name in names.items()},
        cameras={name: _camera(matrices[number]) for number, name in names.items()},
        folder=folder,
        convention=COLMAP,
        unit="metre",
    )


def _camera(matrix: Float64[np.ndarray, "3 3"]) -> pycolmap.Camera:
    params = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + PIXEL_CENTER, matrix[1, 2] + PIXEL_CENTER]
    return pycolmap.Camera(model="PINHOLE", width=0, height=0, params=params)


def read_intrinsics(path: Path) -> Float64[np.ndarray, "3 3"]:
    """Read the intrinsic matrix of full frames: lines `fx: 1.0`, fy, cx, cy.

    Raises:
        InputError: The file is missing, or a line of it.
    """
    found = dict(re.findall(r"^(fx|fy|cx|cy):\s*(\S+)\s*$", read_text(path), flags=re.MULTILINE))
    try:
        fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path} must have the lines fx: ..., fy: ..., cx: ..., cy: ..., each a number"
        ) from error
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
