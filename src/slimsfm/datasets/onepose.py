"""The OnePose data set [1] and OnePose_LowTexture [2]: reader and writer of their layout.

    ROOT/OBJECT/box3d_corners.txt         8 rows x y z: corners of the object's box in its frame, in meters
    ROOT/OBJECT/SEQUENCE/Frames.m4v       the video; not read
    ROOT/OBJECT/SEQUENCE/intrinsics.txt   four lines `fx: 1.0` ... fy, cx, cy: of the full frames
    ROOT/OBJECT/SEQUENCE/color/7.png      a crop of frame 7 around the object, 512 pixels wide and high
    ROOT/OBJECT/SEQUENCE/intrin_ba/7.txt  3x3: the intrinsic matrix of that crop
    ROOT/OBJECT/SEQUENCE/poses_ba/7.txt   4x4: camera from object in that frame, refined by bundle adjustment
    ROOT/OBJECT/SEQUENCE/color_full/7.png the full frame 7 of the video; not published
    ROOT/OBJECT/model_eval.ply            LowTexture only: the scanned model in the object's frame, in meters;
                                          or model.ply; may be missing
    ROOT/OBJECT/diameter.txt              LowTexture only: its diameter in meters; may be missing

ROOT is train_data, val_data, test_data, sample_data or lowtexture_test_data. An object has a name such as
0408-colorbox-box and its sequences colorbox-1, colorbox-2, ... The authors' `video2img.py` extracts the full
frames from the videos; it must extract all frames, because it numbers the extracted ones. Several videos have
more frames than poses, and nothing says which belong together: such a sequence is an error for full frames,
but its crops can be read. The matrices of the crops do not describe the full frames. The writer produces full
frames.

Conventions, from the authors' own tools: the corners run (-x -y -z), (+x -y -z), (+x -y +z), (-x -y +z) and
the same four at +y; the reader accepts any order. The camera looks along +z, y down, as in COLMAP. Published
videos have 30 frames per second: a `frame_step` of 15 gives two per second. The first sequence of an object,
by the numbers in their names, is for mapping, and the last one for queries. The authors pass these matrices
and keypoints whose top-left pixel has its center at (0, 0) to OpenCV's PnP, so the convention is OpenCV's,
also for crops, which are warped by the same transform as their matrices.

LowTexture has 40 objects with two sequences each, of which the crops are published, and scanned models of
eight objects. Without diameter.txt the diameter is the largest distance between two vertices; the authors use
the diagonal of the model's axis-aligned box, which is slightly longer. No object counts as symmetric.

References:
    [1] Sun et al., OnePose: One-Shot Object Pose Estimation without CAD Models, CVPR 2022.
        https://github.com/zju3dv/OnePose
    [2] He et al., OnePose++: Keypoint-Free One-Shot Object Pose Estimation without CAD Models, NeurIPS 2022.
        https://github.com/zju3dv/OnePose_Plus_Plus
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from slimsfm.datasets.base import (
    LoadOptions,
    ObjectModel,
    ObjectSequences,
    PosedSequence,
    check_size,
    read_object_model,
)
from slimsfm.datasets.reading import (
    check_frame_step,
    check_object_name,
    check_paired,
    equal_size,
    folders,
    image_size,
)
from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.mapping.known_poses.onepose import read_intrinsics
from slimsfm.mapping.known_poses.values import (
    PIXEL_CENTER,
    numbered,
    pinhole_camera,
    read_matrix,
    read_pose,
)
from slimsfm.mapping.model import read_box

FrameKind = Literal["full", "cropped"]
"""Which images of a sequence to read."""

_SPLITS = ("train_data", "val_data", "test_data", "sample_data", "lowtexture_test_data")

_MORE_FRAMES = "; if a video has more frames than poses, read the crops (`frames='cropped'`)"

_CORNER_ORDER = [0, 4, 5, 1, 2, 6, 7, 3]
"""Index in `Box.corners` of the k-th corner of the file."""


@dataclass(frozen=True, kw_only=True)
class OnePose:
    """The OnePose data set: phone videos of objects, each with its box."""

    path: Path
    """Folder with one folder per object, such as test_data."""

    frames: FrameKind = "full"
    """Full frames of the videos (color_full), or the published crops around the object (color)."""

    frame_step: int = 15
    """Use every n-th frame of the videos; 15 gives two per second."""

    def __post_init__(self) -> None:
        check_frame_step(self.frame_step)

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects."""
        return object_names(self.path)

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:  # noqa: ARG002
        """Read one object: the first sequence for mapping, the last one for queries."""
        check_object_name(name, self.names(), self.path)
        return read_object(self.path / name, frame_step=self.frame_step, frames=self.frames)


@dataclass(frozen=True, kw_only=True)
class OnePoseLowTexture:
    """The OnePose_LowTexture data set: objects with little texture, some with scanned models."""

    path: Path
    """Folder with one folder per object: lowtexture_test_data."""

    frames: FrameKind = "cropped"
    """The published crops around the object (color), or full frames of the videos (color_full)."""

    frame_step: int = 15
    """Use every n-th frame of the videos; 15 gives two per second."""

    def __post_init__(self) -> None:
        check_frame_step(self.frame_step)

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects."""
        return object_names(self.path)

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:  # noqa: ARG002
        """Read one object, with its scanned model if there is one."""
        check_object_name(name, self.names(), self.path)
        made = read_object(self.path / name, frame_step=self.frame_step, frames=self.frames)
        return replace(made, model=_read_scan(self.path / name, made.box))


def _read_scan(directory: Path, box: Box) -> ObjectModel | None:
    scans = [path for name in ("model_eval.ply", "model.ply") if (path := directory / name).is_file()]
    if not scans:
        return None
    diameter = None
    if (path := directory / "diameter.txt").exists():
        diameter = float(read_matrix(path, (1,), 1)[0, 0])
        check_size(diameter, box, f"{path}, in meters,")
    return read_object_model(scans[0], box, diameter=diameter, symmetric=False)


def object_names(directory: Path) -> tuple[str, ...]:
    """Sorted names of the objects in a folder.

    Raises:
        InputError: The folder holds no object, or the objects are one level further down.
    """
    names = sorted(path.name for path in folders(directory))
    if not names:
        raise InputError(f"{directory} holds no folder: pass the folder with one folder per object")
    if splits := [name for name in names if name in _SPLITS]:
        raise InputError(f"{directory} holds {', '.join(splits)}: pass the folder {directory / splits[0]}")
    return tuple(names)


def read_object(directory: Path, *, frame_step: int = 1, frames: FrameKind = "full") -> ObjectSequences:
    """Read an object: its box, its first sequence for mapping and its last for queries.

    Args:
        directory: Folder of the object, named after it. Its folders whose names end with a dash and a number
            are the sequences.
        frame_step: Use every n-th frame of both videos, starting with the first.
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
            f"{directory} holds {len(sequences)} of the sequences NAME-1, NAME-2, ...: two are required, "
            "one for mapping and one for queries"
        )
    mapping, query = (read_sequence(sequences[k], frame_step=frame_step, frames=frames) for k in (0, -1))
    return ObjectSequences(name=directory.name, mapping=mapping, query=query, box=box)


def read_sequence(directory: Path, *, frame_step: int = 1, frames: FrameKind = "full") -> PosedSequence:
    """Read the frames of one video, their cameras and poses.

    Raises:
        InputError: A file is missing or damaged, or frames and poses do not match.
    """
    folder = directory / ("color_full" if frames == "full" else "color")
    if frames == "full" and not folder.is_dir() and (directory / "color").is_dir():
        raise InputError(
            f"{folder} is missing: extract the full frames from Frames.m4v with the authors' video2img.py, "
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
    return (pinhole_camera(read_intrinsics(path), size, path),) * len(chosen)


def _cameras_of_crops(
    directory: Path, images: dict[int, Path], chosen: list[int]
) -> tuple[pycolmap.Camera, ...]:
    matrices = numbered(directory / "intrin_ba", ".txt")
    check_paired(images, matrices, "matrix")
    return tuple(
        pinhole_camera(read_matrix(matrices[number], (3,), 3), image_size(images[number]), matrices[number])
        for number in chosen
    )


def image_path(sequence: Path, number: int) -> Path:
    """Path of a full frame of a sequence."""
    return sequence / "color_full" / f"{number}.png"


def write_box(directory: Path, box: Box) -> None:
    """Write the box of an object into its folder."""
    directory.mkdir(parents=True, exist_ok=True)
    np.savetxt(directory / "box3d_corners.txt", box.corners[_CORNER_ORDER])


def write_annotation(
    sequence: Path, camera: pycolmap.Camera, cam_from_world: Sequence[pycolmap.Rigid3d]
) -> None:
    """Write the intrinsics and poses of a sequence, and create the folder for its full frames.

    Raises:
        ValueError: The camera has distortion, which the layout cannot store.
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
