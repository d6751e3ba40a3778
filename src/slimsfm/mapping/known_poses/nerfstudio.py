"""`transforms.json` of nerfstudio [1] and instant-ngp [2], also as exported from Polycam, Record3D or ARKit.

Matrices map the camera's frame to the world's; the camera's axes are OpenGL's. Intrinsics are those of a
frame or else of the file, in pixels whose top-left corner is (0, 0), as in COLMAP. The frame of the world is
that of the matrices as they are written; `applied_transform`, which says how nerfstudio turned an earlier
frame into it, is not undone. Nothing in the format states the unit. Poses of devices are in meters; files
that carry a trace of Structure from Motion are of an unknown unit.

References:
    [1] https://docs.nerf.studio/quickstart/data_conventions.html
    [2] https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from slimsfm.errors import InputError
from slimsfm.files import contents_of, plain, read_json
from slimsfm.mapping.conventions import PoseConvention
from slimsfm.mapping.known_poses.given import GivenPoses
from slimsfm.mapping.known_poses.values import rigid

FILE = "transforms.json"
_CONVENTION = PoseConvention(camera_to_world=True, opengl=True)
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_PERSPECTIVE = (
    "OPENCV",
    "PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
)
_OF_SFM = ("ply_file_path", "aabb_scale", "camera_angle_x")  # by COLMAP scripts of nerfstudio, instant-ngp
_OF_SFM_FRAMES = ("colmap_im_id", "sharpness")


@dataclass(frozen=True, kw_only=True)
class _Intrinsics:
    """The keys of a frame or of the file."""

    camera_model: str | None = None
    is_fisheye: bool = False
    w: float = 0.0
    h: float = 0.0
    fl_x: float | None = None
    fl_y: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def camera(self, source: str) -> pycolmap.Camera:
        """The camera.

        Raises:
            InputError: A key is missing, or the model is none that is known.
        """
        fl_x = self.fl_x or _focal(self.w, self.camera_angle_x)
        fl_y = self.fl_y or _focal(self.h, self.camera_angle_y) or fl_x
        if not fl_x or not fl_y:
            raise InputError(f"{source}: has no focal length (fl_x, or camera_angle_x with w)")
        cx, cy = (side / 2 if at is None else at for side, at in ((self.w, self.cx), (self.h, self.cy)))
        if not cx or not cy:
            raise InputError(f"{source}: has no principal point (cx and cy) and no size (w and h)")
        name, distortion = self._model(source)
        size = {"width": int(self.w), "height": int(self.h)}
        return pycolmap.Camera(model=name, **size, params=[fl_x, fl_y, cx, cy, *distortion])

    def _model(self, source: str) -> tuple[str, list[float]]:
        name = self.camera_model or "OPENCV"
        if self.is_fisheye or name in _FISHEYE:
            return "OPENCV_FISHEYE", [self.k1, self.k2, self.k3, self.k4]
        if name not in _PERSPECTIVE or self.k4:
            what = "distortion k4" if name in _PERSPECTIVE else f"camera_model {name}"
            raise InputError(f"{source}: {what} is not supported; undistort the images to PINHOLE first")
        if self.k3:
            return "FULL_OPENCV", [self.k1, self.k2, self.p1, self.p2, self.k3, 0.0, 0.0, 0.0]
        distortion = [self.k1, self.k2, self.p1, self.p2]
        return ("OPENCV", distortion) if any(distortion) else ("PINHOLE", [])


def _focal(side: float, angle: float | None) -> float:
    return side / 2 / math.tan(angle / 2) if side and angle else 0.0


def recognizes(path: Path) -> bool:
    """Whether this is such a file, by its name, or a folder that holds transforms.json."""
    return path.suffix.lower() == ".json" if path.is_file() else (path / FILE).is_file()


def read(path: Path) -> GivenPoses:
    """Read poses and intrinsics.

    Raises:
        InputError: The file is damaged, or a pose or a camera is none.
    """
    path = path / FILE if path.is_dir() else path
    with contents_of(path, "must be a transforms.json of nerfstudio or instant-ngp"):
        data = plain(read_json(path), dict[str, Any])
        frames = plain(data["frames"], list[dict[str, Any]])
        poses, cameras = {}, {}
        for number, frame in enumerate(frames):
            name = plain(frame["file_path"], str)
            source = f"frame {number} ({name!r})"
            if name in poses:
                raise InputError(f"{source}: an image has two poses")
            matrix = np.array(plain(frame["transform_matrix"], list[list[float]]), np.float64)
            poses[name] = _CONVENTION.cam_from_world(rigid(matrix, source))
            cameras[name] = plain({**data, **frame}, _Intrinsics).camera(source)
    traces = [key for key in _OF_SFM if key in data]
    traces += [key for key in _OF_SFM_FRAMES if any(key in frame for frame in frames)]
    return GivenPoses(
        source=path,
        key="name",
        cam_from_world=poses,
        cameras=cameras,
        folder=path.parent,
        convention=_CONVENTION,
        unit="unknown" if traces else "metre",
        notes=(_note(traces),),
    )


def _note(traces: list[str]) -> str:
    if traces:
        return (
            f"the unit of the poses is taken as unknown, because {', '.join(traces)} points to Structure "
            "from Motion; `unit='metre'` says otherwise"
        )
    return (
        "the poses are taken as a device's, in meters, because nothing in the file points to Structure "
        "from Motion; `unit='unknown'` says otherwise"
    )
