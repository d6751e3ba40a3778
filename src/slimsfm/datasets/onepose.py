"""The directory layout of the OnePose data set [1], read and written.

    ROOT/OBJECT/box3d_corners.txt         8 rows x y z: corners of the object's box, in its frame, in metres
    ROOT/OBJECT/SEQUENCE/intrinsics.txt   four lines `fx: 1.0` ... fy, cx, cy: of the full frames
    ROOT/OBJECT/SEQUENCE/color_full/7.png the full frame number 7 of the video
    ROOT/OBJECT/SEQUENCE/poses_ba/7.txt   4x4: camera from object of that frame, refined by bundle adjustment

What this relies on, from the authors' own tools: the corners run (-x -y -z), (+x -y -z), (+x -y +z),
(-x -y +z) and the same four at +y; any order is read. The camera looks along +z, y down, as in COLMAP. The
published folders `color` and `intrin_ba` hold crops around the object and the matrices of those crops, which
do not describe `color_full`: neither is read or written. Published videos have 30 frames a second: a
`frame_step` of 15 gives two a second. The first sequence of an object, by the numbers in their names, maps
it, and the last one queries it.

Files give the principal point as OpenCV does, with the centre of the top-left pixel at (0, 0): the authors
put keypoints of that convention and these matrices together into OpenCV's PnP. So COLMAP's cx is the file's
plus 0.5, here and nowhere else.

References:
    [1] Sun et al., OnePose: One-Shot Object Pose Estimation without CAD Models, CVPR 2022.
        https://github.com/zju3dv/OnePose
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image as PilImage

from slimsfm.errors import ImageError, InputError
from slimsfm.geometry import Box
from slimsfm.mapping.box import read_box

_CORNER_ORDER = [0, 4, 5, 1, 2, 6, 7, 3]
"""Which corner of a `Box` is the k-th of the file."""

_PIXEL_CENTER = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSequence:
    """Frames of a video and where its camera stood."""

    image_paths: tuple[Path, ...]
    """In the order of the video."""

    camera: pycolmap.Camera
    """Of every frame."""

    cam_from_world: tuple[pycolmap.Rigid3d, ...]
    """One a frame; the world is the frame of the object."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectSequences:
    """An object, the video that maps it and the video that asks for poses."""

    name: str
    mapping: PosedSequence
    query: PosedSequence
    box: Box
    """In the frame of the object, in metres."""


def read_dataset(directory: Path, *, frame_step: int = 1) -> list[ObjectSequences]:
    """Read every object of a data set, sorted by name.

    Args:
        directory: Holds one folder an object.
        frame_step: As of `read_object`.

    Raises:
        InputError: There is no object, or one of them cannot be read.
    """
    objects = _folders(directory)
    if not objects:
        raise InputError(f"{directory} holds no folder: give the folder whose folders are the objects")
    return [read_object(path, frame_step=frame_step) for path in objects]


def read_object(directory: Path, *, frame_step: int = 1) -> ObjectSequences:
    """Read an object: its box, its first sequence to map it and its last to query it.

    Args:
        directory: The object's folder; its name is the object's.
        frame_step: Take each `frame_step`-th frame of both videos, from the first on.

    Raises:
        InputError: A file is missing or damaged; the message names the first one and what to do.
        ValueError: `frame_step` is below 1.
    """
    if frame_step < 1:
        raise ValueError(f"frame_step must be at least 1, got {frame_step}")
    box = read_box(directory / "box3d_corners.txt")
    sequences = _folders(directory)
    if len(sequences) < 2:
        raise InputError(
            f"{directory} holds {len(sequences)} sequences: it takes two, one to map and one to query"
        )
    mapping, query = (read_sequence(sequences[k], frame_step=frame_step) for k in (0, -1))
    return ObjectSequences(name=directory.name, mapping=mapping, query=query, box=box)


def read_sequence(directory: Path, *, frame_step: int = 1) -> PosedSequence:
    """Read the frames of one video and their poses.

    Raises:
        InputError: A file is missing or damaged, or frames and poses do not go together.
    """
    images, poses = _numbered(directory / "color_full", ".png"), _numbered(directory / "poses_ba", ".txt")
    if alone := sorted(images.keys() ^ poses.keys()):
        path = (images | poses)[alone[0]]
        other = "pose in poses_ba" if alone[0] in images else "frame in color_full"
        raise InputError(
            f"{path} has no {other}: add it or take this file away ({len(images)} frames, {len(poses)} poses)"
        )
    chosen = sorted(images)[::frame_step]
    return PosedSequence(
        image_paths=tuple(images[number] for number in chosen),
        camera=_read_camera(directory / "intrinsics.txt", images[chosen[0]]),
        cam_from_world=tuple(_read_pose(poses[number]) for number in chosen),
    )


def image_path(sequence: Path, number: int) -> Path:
    """Where the frame of a number lies in a sequence."""
    return sequence / "color_full" / f"{number}.png"


def write_box(directory: Path, box: Box) -> None:
    """Write the box of the object whose folder is given."""
    directory.mkdir(parents=True, exist_ok=True)
    np.savetxt(directory / "box3d_corners.txt", box.corners[_CORNER_ORDER])


def write_annotation(
    sequence: Path, camera: pycolmap.Camera, cam_from_world: Sequence[pycolmap.Rigid3d]
) -> None:
    """Write the intrinsics and the poses of a sequence, and make the folder for its frames.

    Raises:
        ValueError: The camera has distortion, for which the layout has no place.
    """
    if camera.model not in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE):
        raise ValueError(f"camera must be a pinhole camera, got {camera.model.name}")
    for folder in ("color_full", "poses_ba"):
        (sequence / folder).mkdir(parents=True, exist_ok=True)
    center = (camera.principal_point_x - _PIXEL_CENTER, camera.principal_point_y - _PIXEL_CENTER)
    values = zip(
        ("fx", "fy", "cx", "cy"), (camera.focal_length_x, camera.focal_length_y, *center), strict=True
    )
    (sequence / "intrinsics.txt").write_text("\n".join(f"{key}: {value!r}" for key, value in values))
    for number, pose in enumerate(cam_from_world):
        np.savetxt(sequence / "poses_ba" / f"{number}.txt", np.vstack([pose.matrix(), (0, 0, 0, 1)]))


def _folders(directory: Path) -> list[Path]:
    """Visible folders in the order of the numbers in their names, so that box-10 comes after box-2."""
    if not directory.is_dir():
        raise InputError(f"{directory} is no folder: check the path")
    folders = [path for path in directory.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(
        folders, key=lambda path: [(int(d or -1), text) for d, text in re.findall(r"(\d+)|(\D+)", path.name)]
    )


def _numbered(directory: Path, suffix: str) -> dict[int, Path]:
    paths = {int(p.stem): p for p in directory.glob(f"*{suffix}") if p.stem.isdecimal()}
    if not paths:
        raise InputError(f"{directory} holds no file 0{suffix}, 1{suffix}, ...: it takes one for each frame")
    return paths


def _read_camera(path: Path, first_image: Path) -> pycolmap.Camera:
    found = dict(re.findall(r"^(fx|fy|cx|cy):\s*(\S+)\s*$", _read_text(path), flags=re.MULTILINE))
    try:
        fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path} must have the lines fx: ..., fy: ..., cx: ..., cy: ..., each a number"
        ) from error
    if not (np.all(np.isfinite([fx, fy, cx, cy])) and fx > 0 and fy > 0):
        raise InputError(
            f"{path} must have positive focal lengths and a finite centre, got {fx} {fy} {cx} {cy}"
        )
    try:
        with PilImage.open(first_image) as image:
            width, height = image.size
    except OSError as error:
        raise ImageError(f"{first_image} cannot be read as an image: {error}") from error
    params = [fx, fy, cx + _PIXEL_CENTER, cy + _PIXEL_CENTER]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)


def _read_pose(path: Path) -> pycolmap.Rigid3d:
    matrix = _read_matrix(path, (4, 4))
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not (rigid and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)):
        raise InputError(
            f"{path} is no pose: its first three columns must be a rotation and its last row 0 0 0 1"
        )
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), matrix[:3, 3])


def _read_matrix(path: Path, shape: tuple[int, int]) -> np.ndarray:
    text = _read_text(path)
    try:
        rows = np.array(
            [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
        )
    except ValueError as error:
        raise InputError(f"{path} must hold {shape[0]} rows of {shape[1]} numbers: {error}") from error
    if rows.shape != shape or not np.all(np.isfinite(rows)):
        raise InputError(
            f"{path} must hold {shape[0]} rows of {shape[1]} finite numbers, got shape {rows.shape}"
        )
    return rows


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
