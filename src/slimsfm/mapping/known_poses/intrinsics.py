"""Intrinsics for poses that come without: from a file beside them or beside the photos, or from EXIF.

cameras.txt   one camera, as COLMAP writes it
calib.txt     KITTI's projection matrices P0, P1, ... of rectified cameras, of which poses are those of the
              first; the folder image_2 holds the photos of P2
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.errors import InputError
from slimsfm.exif import Exif
from slimsfm.files import contents_of, read_text
from slimsfm.image_files import named
from slimsfm.mapping.camera_file import read_camera
from slimsfm.mapping.extraction import CameraSharing, guess_cameras
from slimsfm.mapping.known_poses.values import PIXEL_CENTER
from slimsfm.photos import Orientation

CAMERAS, CALIBRATION = "cameras.txt", "calib.txt"


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundIntrinsics:
    """Intrinsics of photos."""

    cameras: Mapping[str, pycolmap.Camera]
    """By name of photo; a camera of width 0 is of the size of its photo."""

    note: str
    """Where they come from."""

    cam_from_posed: pycolmap.Rigid3d = field(default_factory=pycolmap.Rigid3d)
    """From the camera that poses are of to that of the photos."""


def find_intrinsics(
    poses: Path, photos: Path, exifs: Mapping[str, Exif], sharing: CameraSharing, orientation: Orientation
) -> FoundIntrinsics:
    """Find the intrinsics of photos whose poses are known.

    Args:
        poses: File of the poses.
        photos: Folder of the photos.
        exifs: EXIF data of the photos that have a pose, by name.
        sharing: Which photos share a camera, if EXIF has to do.
        orientation: Which pixels of the photos are used.

    Raises:
        InputError: There are none, or a file of them is damaged.
    """
    folders = [poses.parent, photos, photos.absolute().parent]
    for folder in folders:
        if (folder / CAMERAS).is_file():
            camera = read_camera(folder / CAMERAS)
            return FoundIntrinsics(cameras=dict.fromkeys(exifs, camera), note=_note(folder / CAMERAS))
        if (folder / CALIBRATION).is_file():
            return _of_kitti(folder / CALIBRATION, photos, exifs)
    guessed = guess_cameras(exifs, sharing, orientation).by_name
    unknown = [name for name, camera in guessed.items() if not camera.has_prior_focal_length]
    if unknown:
        raise InputError(
            f"{poses}: has no intrinsics, and neither has EXIF of {named('photo(s)', unknown)}; put "
            f"{CAMERAS} (one camera, as COLMAP writes it) or KITTI's {CALIBRATION} beside the poses"
        )
    return FoundIntrinsics(
        cameras=guessed, note="the poses have no intrinsics; those that EXIF guesses are used"
    )


def _note(path: Path) -> str:
    return f"the poses have no intrinsics; those of {path} are used"


def _of_kitti(path: Path, photos: Path, exifs: Mapping[str, Exif]) -> FoundIntrinsics:
    matched = re.fullmatch(r"image_0?(\d)", photos.resolve().name)
    key = f"P{matched[1] if matched else 0}"
    with contents_of(path, f"must hold a line {key}: with the 12 numbers of a projection matrix"):
        lines = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
        projection = np.array([float(word) for word in lines[key].split()], np.float64).reshape(3, 4)
        matrix = projection[:, :3]
        offset = np.linalg.solve(matrix, projection[:, 3])
        params = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + PIXEL_CENTER, matrix[1, 2] + PIXEL_CENTER]
        camera = pycolmap.Camera(model="PINHOLE", width=0, height=0, params=params)
    return FoundIntrinsics(
        cameras=dict.fromkeys(exifs, camera),
        note=f"{_note(path)}, {key}",
        cam_from_posed=pycolmap.Rigid3d(pycolmap.Rotation3d(), offset),
    )
