"""What clients in Python send to a server of maps, and what they make of its answers. Opens no connection."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit, urlunsplit

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import Image
from slimsfm.errors import ImageError, InputError, ServerError
from slimsfm.files import plain
from slimsfm.limits import check_bytes
from slimsfm.pose import Gravity

Picture = bytes | str | Path | Image
"""An image file as bytes, the path of one, or an RGB image, which is sent without losses."""

GivenCamera = pycolmap.Camera | Literal["unknown"] | None
"""PINHOLE or SIMPLE_PINHOLE intrinsics; "unknown" has the focal length estimated; None leaves the choice to
the server, which asks map and EXIF."""

TRIES = 3
"""Number of times that a request is sent while the server asks to try again later."""

_LONGEST_PAUSE_S = 5.0
_TRY_AGAIN = 429, 503


@dataclass(frozen=True, kw_only=True, eq=False)
class RemoteLocalization:
    """The answer of a server."""

    found: bool
    """Whether there is a pose."""

    reason: str | None
    """Why there is none."""

    cam_from_world: pycolmap.Rigid3d | None
    """The pose of the camera."""

    confidence: float | None
    """Probability of a corner error below a tenth of the box's diagonal."""

    predicted_error: float | None
    """Expected mean error of the box's corners, in `unit`."""

    unit: str
    """Unit of the map."""

    map: str
    """Id of the map."""

    map_version: str
    """Version of the map."""

    camera: pycolmap.Camera
    """The intrinsics, with those that were estimated."""

    reply: dict[str, Any] = field(repr=False)
    """The whole answer."""


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where a server is."""

    url: str
    """Address without fragment, with a slash at its end."""

    token: str
    """The token; empty if there is none."""

    @classmethod
    def of(cls, url: str, token: str = "") -> "Address":
        """Take apart an address as `slimsfm serve` prints it, with the token in its fragment.

        Raises:
            InputError: It is no address.
        """
        try:
            parts = urlsplit(url)
        except ValueError as error:
            raise InputError(f"url: {url!r} is no address: {error}") from error
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise InputError(f"url: {url!r} must be an address such as http://localhost:8000")
        in_fragment = parse_qs(parts.fragment).get("token", [""])[0]
        path = parts.path if parts.path.endswith("/") else f"{parts.path}/"
        return cls(url=urlunsplit((parts.scheme, parts.netloc, path, "", "")), token=token or in_fragment)


def file_of(image: Picture) -> bytes:
    """The bytes to send of an image.

    Raises:
        ImageError: The file cannot be read, or the array is no RGB image.
    """
    if isinstance(image, bytes):
        return image
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ImageError(
                f"image must be RGB, uint8 of shape (height, width, 3), got {image.dtype} of {image.shape}"
            )
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    try:
        check_bytes(image, Path(image).stat().st_size)
        return Path(image).read_bytes()
    except OSError as error:
        raise ImageError(f"{image}: cannot be read ({error.strerror})") from error


def parameters_of(
    maps: Sequence[str], camera: GivenCamera, prior: pycolmap.Rigid3d | None, gravity: Gravity | None
) -> dict[str, str]:
    """The query string of a request for localization.

    Raises:
        ValueError: The camera has distortion.
    """
    found = {"map": ",".join(maps)} if maps else {}
    if isinstance(camera, str):
        found["focal"] = camera
    elif camera is not None:
        if camera.model_name not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise ValueError(f"camera must be PINHOLE or SIMPLE_PINHOLE, got {camera.model_name}")
        fx, fy = camera.focal_length_x, camera.focal_length_y
        cx, cy = camera.principal_point_x, camera.principal_point_y
        found |= {"fx": repr(fx), "fy": repr(fy), "cx": repr(cx), "cy": repr(cy)}
    if prior is not None:
        found["prior"] = _listed([*prior.rotation.quat, *prior.translation])
    if gravity is not None:
        found |= {"gravity": _listed(gravity.in_cam), "down": _listed(gravity.in_world)}
    return found


def _listed(values: Any) -> str:
    return ",".join(repr(float(value)) for value in values)


def pause_s(status: int, retry_after: str, tries_left: int) -> float | None:
    """Seconds to wait before a request is sent again; None if it is not."""
    if status not in _TRY_AGAIN or not tries_left or not retry_after.isdigit():
        return None
    return min(float(retry_after), _LONGEST_PAUSE_S)


def answer_of(status: int, content: Any) -> dict[str, Any]:
    """The content of an answer.

    Raises:
        ServerError: It is an error, or the server is another one.
    """
    try:
        content = plain(content, dict[str, Any])
        if 200 <= status < 300:
            return content
        error = plain(content["error"], dict[str, str])
        raise ServerError(f"the server refuses: {error['message']}", status, error["code"])
    except (ValueError, KeyError) as error:
        raise ServerError(f"not an answer of slimsfm serve (status {status})", status) from error


def localization_of(reply: dict[str, Any]) -> RemoteLocalization:
    """An answer with a pose.

    Raises:
        ServerError: It is another answer.
    """
    try:
        given = reply["camera"]
        camera = pycolmap.Camera(
            model=given["model"], width=given["width"], height=given["height"], params=given["params"]
        )
        pose = reply["cam_from_world"]
        return RemoteLocalization(
            **{name: reply[name] for name in _SAME_NAMES},
            cam_from_world=pose
            and pycolmap.Rigid3d(
                pycolmap.Rotation3d(np.array(plain(pose["quaternion_xyzw"], list[float]))),
                np.array(plain(pose["translation"], list[float])),
            ),
            camera=camera,
            reply=reply,
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ServerError(f"not an answer of slimsfm serve: {error}") from error


_SAME_NAMES = "found", "reason", "confidence", "predicted_error", "unit", "map", "map_version"
