"""Poses as a file gives them, before it is known which photo each is of."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pycolmap

from slimsfm.mapping.conventions import PoseConvention

Unit = Literal["metre", "unknown"]
"""Unit of poses."""

PoseKey = Literal["name", "time", "order"]
"""What says which photo a pose is of: the name of a file, the time in seconds, or a number from 0."""

COLMAP = PoseConvention(camera_to_world=False, opengl=False)
"""World to camera, axes as in OpenCV."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenPoses:
    """Poses of a file or folder."""

    source: Path
    """The file or folder."""

    key: PoseKey
    """What the keys of the poses are."""

    cam_from_world: Mapping[str, pycolmap.Rigid3d]
    """Poses by key: a path that is relative to `folder`, a time as it is written, or a number."""

    cameras: Mapping[str, pycolmap.Camera] | None
    """Intrinsics by key; a camera of width 0 is of the size of its photo. None: the file has none."""

    folder: Path
    """Folder that names are relative to."""

    convention: PoseConvention
    """How the matrices were read."""

    unit: Unit
    """Unit of the poses, as far as the file says."""

    notes: tuple[str, ...] = ()
    """Sentences on what was guessed."""
