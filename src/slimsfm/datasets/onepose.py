"""The directory layout of the OnePose data set [1], read and written.

    ROOT/OBJECT/box3d_corners.txt         8 rows x y z: corners of the object's box, in its frame, in metres
    ROOT/OBJECT/SEQUENCE/Frames.m4v       the video; not read
    ROOT/OBJECT/SEQUENCE/intrinsics.txt   four lines `fx: 1.0` ... fy, cx, cy: of the full frames
    ROOT/OBJECT/SEQUENCE/color/7.png      a crop of frame number 7 around the object, 512 pixels wide and high
    ROOT/OBJECT/SEQUENCE/intrin_ba/7.txt  3x3: the intrinsic matrix of that crop
    ROOT/OBJECT/SEQUENCE/poses_ba/7.txt   4x4: camera from object of that frame, refined by bundle adjustment
    ROOT/OBJECT/SEQUENCE/color_full/7.png the full frame number 7 of the video; not published

So the set is published, in ROOTs called train_data, val_data, test_data and sample_data; an object is called
like 0408-colorbox-box and its sequences colorbox-1, colorbox-2, ... The authors' `video2img.py` takes the
full frames out of the videos; it must take all of them, for it numbers those it takes. Several videos have
more frames than poses, and nothing tells which belong together: such a sequence is refused, its crops can be
read. The matrices of the crops do not describe the full frames. What is written here has full frames.

What this relies on, from the authors' own tools: the corners run (-x -y -z), (+x -y -z), (+x -y +z),
(-x -y +z) and the same four at +y; any order is read. The camera looks along +z, y down, as in COLMAP.
Published videos have 30 frames a second: a `frame_step` of 15 gives two a second. The first sequence of an
object, by the numbers in their names, maps it, and the last one queries it. The authors put these matrices
and keypoints whose top-left pixel has its centre at (0, 0) together into OpenCV's PnP: so OpenCV's convention
it is, for crops as well, which are warped by the same transform as their matrices.

References:
    [1] Sun et al., OnePose: One-Shot Object Pose Estimation without CAD Models, CVPR 2022.
        https://github.com/zju3dv/OnePose
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.datasets.base import Making, ObjectSequences, PosedSequence
from slimsfm.datasets.reading import (
    PIXEL_CENTER,
    check_frame_step,
    check_known,
    check_paired,
    equal_size,
    folders,
    image_size,
    numbered,
    pinhole,
    read_matrix,
    read_pose,
    read_text,
)
from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.mapping.box import read_box

Frames = Literal["full", "cropped"]
"""Which images of a sequence are read."""

_SPLITS = ("train_data", "val_data", "test_data", "sample_data", "lowtexture_test_data")

_MORE_FRAMES = "; where a video has more frames than poses, read the crops (`frames='cropped'`)"

_CORNER_ORDER = [0, 4, 5, 1, 2, 6, 7, 3]
"""Which corner of a `Box` is the k-th of the file."""


@dataclass(frozen=True, kw_only=True)
class OnePose:
    """The OnePose data set: objects in videos of a phone, with the box of each."""

    path: Path
    """Folder whose folders are the objects, such as test_data."""

    frames: Frames = "full"
    """Full frames of the videos, from color_full, or the published crops around the object, from color."""

    frame_step: int = 15
    """Take each so manyth frame of the videos; 15 gives two a second."""

    def __post_init__(self) -> None:
        check_frame_step(self.frame_step)

    def names(self) -> tuple[str, ...]:
        """The objects, sorted."""
        return object_names(self.path)

    def load(self, name: str, making: Making) -> ObjectSequences:  # noqa: ARG002
        """Read one object: its first sequence maps it, its last one queries it."""
        check_known(name, self.names(), self.path)
        return read_object(self.path / name, frame_step=self.frame_step, frames=self.frames)


def object_names(directory: Path) -> tuple[str, ...]:
    """The objects of a data set, sorted.

    Raises:
        InputError: There is none, or the objects lie one level further down.
    """
    names = sorted(path.name for path in folders(directory))
    if not names:
        raise InputError(f"{directory} holds no folder: give the folder whose folders are the objects")
    if splits := [name for name in names if name in _SPLITS]:
        raise InputError(f"{directory} holds {', '.join(splits)}: give the folder {directory / splits[0]}")
    return tuple(names)


def read_object(directory: Path, *, frame_step: int = 1, frames: Frames = "full") -> ObjectSequences:
    """Read an object: its box, its first sequence to map it and its last to query it.

    Args:
        directory: The object's folder; its name is the object's. Folders in it that end with a dash and a
            number are its sequences.
        frame_step: Take each `frame_step`-th frame of both videos, from the first on.
        frames: Whether to read full frames or crops.

    Raises:
        InputError: A file is missing or damaged; the message names the first one and what to do.
        ValueError: `frame_step` is below 1.
    """
    check_frame_step(frame_step)
    box = read_box(directory / "box3d_corners.txt")
    sequences = [path for path in folders(directory) if re.search(r"-\d+$", path.name)]
    if len(sequences) < 2:
        raise InputError(
            f"{directory} holds {len(sequences)} sequences, NAME-1, NAME-2, ...: it takes two, one to map "
            "and one to query"
        )
    mapping, query = (read_sequence(sequences[k], frame_step=frame_step, frames=frames) for k in (0, -1))
    return ObjectSequences(name=directory.name, mapping=mapping, query=query, box=box)


def read_sequence(directory: Path, *, frame_step: int = 1, frames: Frames = "full") -> PosedSequence:
    """Read the frames of one video, their cameras and poses.

    Raises:
        InputError: A file is missing or damaged, or frames and poses do not go together.
    """
    folder = directory / ("color_full" if frames == "full" else "color")
    if frames == "full" and not folder.is_dir() and (directory / "color").is_dir():
        raise InputError(
            f"{folder} is missing: take the full frames out of Frames.m4v with the authors' video2img.py, "
            "or read the crops (`frames='cropped'`)"
        )
    images, poses = numbered(folder, ".png"), numbered(directory / "poses_ba", ".txt")
    check_paired(images, poses, "pose", "" if frames == "cropped" else _MORE_FRAMES)
    chosen = list(images)[::frame_step]
    read_cameras = _cameras_of_full_frames if frames == "full" else _cameras_of_crops
    return PosedSequence(
        folder=folder,
        names=tuple(images[number].name for number in chosen),
        cameras=read_cameras(directory, images, chosen),
        cam_from_world=tuple(read_pose(poses[number]) for number in chosen),
    )


def _cameras_of_full_frames(
    directory: Path, images: dict[int, Path], chosen: list[int]
) -> tuple[pycolmap.Camera, ...]:
    path = directory / "intrinsics.txt"
    size = equal_size([images[number] for number in chosen])
    return (pinhole(_read_intrinsics(path), size, path),) * len(chosen)


def _cameras_of_crops(
    directory: Path, images: dict[int, Path], chosen: list[int]
) -> tuple[pycolmap.Camera, ...]:
    matrices = numbered(directory / "intrin_ba", ".txt")
    check_paired(images, matrices, "matrix")
    return tuple(
        pinhole(read_matrix(matrices[number], (3,), 3), image_size(images[number]), matrices[number])
        for number in chosen
    )


def _read_intrinsics(path: Path) -> Float64[np.ndarray, "3 3"]:
    found = dict(re.findall(r"^(fx|fy|cx|cy):\s*(\S+)\s*$", read_text(path), flags=re.MULTILINE))
    try:
        fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path} must have the lines fx: ..., fy: ..., cx: ..., cy: ..., each a number"
        ) from error
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def image_path(sequence: Path, number: int) -> Path:
    """Where the full frame of a number lies in a sequence."""
    return sequence / "color_full" / f"{number}.png"


def write_box(directory: Path, box: Box) -> None:
    """Write the box of the object whose folder is given."""
    directory.mkdir(parents=True, exist_ok=True)
    np.savetxt(directory / "box3d_corners.txt", box.corners[_CORNER_ORDER])


def write_annotation(
    sequence: Path, camera: pycolmap.Camera, cam_from_world: Sequence[pycolmap.Rigid3d]
) -> None:
    """Write the intrinsics and the poses of a sequence, and make the folder for its full frames.

    Raises:
        ValueError: The camera has distortion, for which the layout has no place.
    """
    if camera.model not in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE):
        raise ValueError(f"camera must be a pinhole camera, got {camera.model.name}")
    for folder in ("color_full", "poses_ba"):
        (sequence / folder).mkdir(parents=True, exist_ok=True)
    center = (camera.principal_point_x - PIXEL_CENTER, camera.principal_point_y - PIXEL_CENTER)
    values = zip(
        ("fx", "fy", "cx", "cy"), (camera.focal_length_x, camera.focal_length_y, *center), strict=True
    )
    (sequence / "intrinsics.txt").write_text("\n".join(f"{key}: {value!r}" for key, value in values))
    for number, pose in enumerate(cam_from_world):
        np.savetxt(sequence / "poses_ba" / f"{number}.txt", np.vstack([pose.matrix(), (0, 0, 0, 1)]))
