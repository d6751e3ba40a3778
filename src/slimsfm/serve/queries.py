"""What a request for localization asks: maps, intrinsics, prior pose and gravity, from the query string."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Literal

import numpy as np
import pycolmap

from slimsfm.lenses import camera_fault
from slimsfm.pose import Gravity
from slimsfm.serve.errors import ApiError, bad_request

Parameters = Mapping[str, str]
"""The parameters of a request by name, each given once."""

KNOWN = frozenset({"map", "fx", "fy", "cx", "cy", "focal", "prior", "gravity", "down"})
"""Names of the parameters."""

_LARGEST = 1e9  # number that may mean anything


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera whose size is that of the image."""

    fx: float
    fy: float
    cx: float | None = None
    cy: float | None = None

    def camera(self, width: int, height: int) -> pycolmap.Camera:
        """The camera of an image of this size; the principal point is its center unless given.

        Raises:
            ApiError: No lens has such intrinsics (422).
        """
        center = (width / 2, height / 2)
        cx, cy = (
            given if given is not None else half for given, half in zip(self._center, center, strict=True)
        )
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 1.0, width, height)
        camera.params = [self.fx, self.fy, cx, cy]
        if fault := camera_fault(camera):
            raise ApiError(422, "bad_camera", f"the intrinsics are impossible: {fault}")
        return camera

    @property
    def _center(self) -> tuple[float | None, float | None]:
        return self.cx, self.cy


CameraChoice = Intrinsics | Literal["unknown", "map"]
"""Intrinsics; nothing is known; or what the map and EXIF say, as the library chooses them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalizeQuery:
    """What a request for localization asks."""

    maps: tuple[str, ...] = ()
    """Ids of the maps to search; all if empty."""

    camera: CameraChoice = "map"
    """The intrinsics of the image."""

    prior: pycolmap.Rigid3d | None = None
    """About where the camera is: `cam_from_world`."""

    gravity: Gravity | None = None
    """Direction of gravity in the map and in the image."""


def query_of(parameters: Parameters) -> LocalizeQuery:
    """Parse the parameters of a request.

    Raises:
        ApiError: One is unknown, no number, or contradicts another (400).
    """
    for name in parameters:
        if name not in KNOWN:
            known = ", ".join(sorted(KNOWN))
            raise bad_request("bad_parameter", f"there is no parameter {name[:40]!r}; there are {known}")
    maps = tuple(one for one in parameters.get("map", "").split(",") if one)
    return LocalizeQuery(
        maps=maps, camera=_camera(parameters), prior=_prior(parameters), gravity=_gravity(parameters)
    )


def intrinsics_of(values: Mapping[str, object]) -> Intrinsics:
    """Intrinsics by name, as numbers or texts.

    Raises:
        ApiError: `fx` is missing, or a value is no finite number (400).
    """
    numbers = {name: _number(name, values[name]) for name in ("fx", "fy", "cx", "cy") if name in values}
    if "fx" not in numbers:
        raise bad_request("bad_parameter", "intrinsics need fx, and may have fy, cx and cy, in pixels")
    if ("cx" in numbers) != ("cy" in numbers):
        raise bad_request("bad_parameter", "cx and cy go together")
    return Intrinsics(**{"fy": numbers["fx"], **numbers})


def _camera(parameters: Parameters) -> CameraChoice:
    focal, given = parameters.get("focal"), any(name in parameters for name in ("fx", "fy", "cx", "cy"))
    if focal not in (None, "unknown"):
        raise bad_request("bad_parameter", f"focal can only be unknown, got {focal[:40]!r}")
    if focal and given:
        raise bad_request("bad_parameter", "give either focal=unknown or fx, fy, cx and cy")
    return intrinsics_of(parameters) if given else "unknown" if focal else "map"


def _prior(parameters: Parameters) -> pycolmap.Rigid3d | None:
    if "prior" not in parameters:
        return None
    values = np.array(_numbers("prior", parameters["prior"], 7, "qx,qy,qz,qw,tx,ty,tz"))
    norm = float(np.linalg.norm(values[:4]))
    if not 1e-3 < norm < 1e3:
        raise bad_request("bad_parameter", "prior: the quaternion qx,qy,qz,qw must not be zero")
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[:4] / norm), values[4:])


def _gravity(parameters: Parameters) -> Gravity | None:
    if ("gravity" in parameters) != ("down" in parameters):
        raise bad_request("bad_parameter", "gravity (in the camera) and down (in the map) go together")
    if "gravity" not in parameters:
        return None
    in_cam, in_world = (
        np.array(_numbers(name, parameters[name], 3, "x,y,z")) for name in ("gravity", "down")
    )
    if not np.any(in_cam) or not np.any(in_world):
        raise bad_request("bad_parameter", "gravity and down must not be zero")
    return Gravity(in_world=in_world, in_cam=in_cam)


def _numbers(name: str, text: str, count: int, names: str) -> Sequence[float]:
    values = text.split(",")
    if len(values) != count:
        raise bad_request("bad_parameter", f"{name} must be {count} numbers: {names}")
    return [_number(name, value) for value in values]


def _number(name: str, value: object) -> float:
    try:
        number = (
            float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else None
        )
    except (ValueError, OverflowError):
        number = None
    if number is None or not isfinite(number) or abs(number) > _LARGEST:
        raise bad_request("bad_parameter", f"{name} must be a finite number, got {str(value)[:40]!r}")
    return number
