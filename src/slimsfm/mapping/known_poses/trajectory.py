"""Text files of one pose per line: trajectories of TUM [1] and poses of KITTI [2].

A line of TUM is `time tx ty tz qx qy qz qw`, one of KITTI the twelve numbers of a 3x4 matrix. Both map the
camera's frame to the world's, with axes as in OpenCV, in meters. A pose of TUM is of the photo whose name is
the nearest time, or of that frame of a video. Pose i of KITTI is of photo i. Neither has intrinsics: see
`known_poses.intrinsics`.

References:
    [1] https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
    [2] https://www.cvlibs.net/datasets/kitti/eval_odometry.php
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.files import contents_of, read_text
from slimsfm.mapping.conventions import PoseConvention
from slimsfm.mapping.known_poses.given import GivenPoses
from slimsfm.mapping.known_poses.values import rigid

_TUM, _KITTI = 8, 12  # numbers in a line
_UNIT = 0.01  # by which the length of a quaternion may be off
_CONVENTION = PoseConvention(camera_to_world=True, opengl=False)


def recognizes(path: Path) -> bool:
    """Whether this is a text file."""
    return path.is_file() and path.suffix.lower() in (".txt", ".tum", ".csv", ".freiburg", ".kitti")


def read(path: Path) -> GivenPoses:
    """Read poses, and intrinsics from a file beside them.

    Raises:
        InputError: A file is damaged, or the poses are neither TUM's nor KITTI's.
    """
    with contents_of(path, "must hold lines of 8 numbers (TUM) or 12 (KITTI)"):
        lines = [line.replace(",", " ").split() for line in read_text(path).splitlines()]
        lines = [words for words in lines if words and not words[0].startswith("#")]
        counts = {len(words) for words in lines}
        if counts not in ({_TUM}, {_KITTI}):
            raise ValueError(f"its lines have {', '.join(map(str, sorted(counts))) or 'no'} numbers")
        values = np.array([[float(word) for word in words] for words in lines], np.float64)
        if not np.isfinite(values).all():
            raise ValueError("a number is not finite")
        is_kitti = values.shape[1] == _KITTI
        keys = [str(row) if is_kitti else words[0] for row, words in enumerate(lines)]
        if len(set(keys)) < len(keys):
            raise ValueError("a time has two poses")
        poses = {
            key: (_kitti if is_kitti else _tum)(row, f"line {number}")
            for number, (key, row) in enumerate(zip(keys, values, strict=True), start=1)
        }
    return GivenPoses(
        source=path,
        key="order" if is_kitti else "time",
        cam_from_world={key: _CONVENTION.cam_from_world(pose) for key, pose in poses.items()},
        cameras=None,
        folder=path.parent,
        convention=_CONVENTION,
        unit="metre",
    )


def _tum(values: Float64[np.ndarray, " 8"], source: str) -> pycolmap.Rigid3d:
    length = float(np.linalg.norm(values[4:]))
    if abs(length - 1) > _UNIT:
        raise InputError(f"{source}: the quaternion has the length {length:g}, not 1")
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[4:] / length), values[1:4])


def _kitti(values: Float64[np.ndarray, " 12"], source: str) -> pycolmap.Rigid3d:
    return rigid(values.reshape(3, 4), source)
