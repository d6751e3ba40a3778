"""What a client of `/v1/track` sends: a hello as text, then frames with a header of 16 bytes."""

import json
import struct
from dataclasses import dataclass
from typing import Any

from slimsfm.files import plain
from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.images import LARGEST_SIDE, MAX_PIXELS, SMALLEST_SIDE
from slimsfm.serve.queries import CameraChoice, intrinsics_of

VERSION = 1
"""Version of the protocol."""

HEADER = struct.Struct("<BBHId")
"""Version, EXIF orientation, zero, sequence number, capture time in milliseconds."""

_MOST_MAPS = 100
_LONGEST_HELLO = 10_000


@dataclass(frozen=True, kw_only=True)
class Hello:
    """What a client wants to be tracked."""

    maps: tuple[str, ...]
    """Ids of maps; all if empty."""

    width: int
    """Width of the upright frames."""

    height: int
    """Height of the upright frames."""

    camera: CameraChoice
    """Intrinsics of the upright frames."""

    token: str
    """The token, if it was not sent as a header."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One frame."""

    sequence: int
    """Its number, chosen by the client."""

    captured: float
    """When it was taken, in milliseconds of the client's clock."""

    orientation: int
    """EXIF orientation, from 1 to 8."""

    jpeg: bytes
    """The picture."""


def parse_hello(text: str) -> Hello:
    """Parse the first message.

    Raises:
        ApiError: It is no hello of this version, or a value is impossible.
    """
    if len(text) > _LONGEST_HELLO:
        raise bad_request("bad_message", "the hello is too long")
    try:
        data = json.loads(text, parse_constant=_refuse)
        data = plain(data, dict[str, Any])
        kind, version = data["type"], data["version"]
        maps = plain(data.get("maps") or (), tuple[str, ...])
        width, height = plain(data["width"], int), plain(data["height"], int)
        token = plain(data.get("token") or "", str)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise bad_request("bad_message", f"not a readable hello: {str(error)[:100]}") from error
    if kind != "hello" or version != VERSION:
        raise bad_request("bad_message", f"the first message must be a hello of version {VERSION}")
    is_possible = min(width, height) >= SMALLEST_SIDE and max(width, height) <= LARGEST_SIDE
    if not is_possible or width * height > MAX_PIXELS or len(maps) > _MOST_MAPS:
        raise bad_request(
            "bad_message", f"frames of {width}x{height} pixels or {len(maps)} maps are not possible"
        )
    return Hello(maps=maps, width=width, height=height, camera=_camera(data.get("camera")), token=token)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


def _camera(given: object) -> CameraChoice:
    if given is None:
        return "unknown"
    if given == "map":
        return "map"
    if not isinstance(given, dict):
        raise bad_request("bad_message", 'camera must have fx, fy, cx and cy, or be null or "map"')
    return intrinsics_of(given)


def parse_frame(data: bytes) -> Frame:
    """Split a binary message into header and picture.

    Raises:
        ApiError: The header is not that of a frame, or no JPEG follows.
    """
    if len(data) <= HEADER.size:
        raise bad_request("bad_message", f"a frame has a header of {HEADER.size} bytes and a JPEG")
    version, orientation, zero, sequence, captured = HEADER.unpack_from(data)
    if version != VERSION or zero or not 1 <= orientation <= 8 or not abs(captured) < 1e15:
        raise bad_request("bad_message", f"not the header of a frame of version {VERSION}")
    jpeg = data[HEADER.size :]
    if not jpeg.startswith(b"\xff\xd8\xff"):
        raise bad_request("bad_message", "no JPEG follows the header of the frame")
    return Frame(sequence=sequence, captured=captured, orientation=orientation, jpeg=jpeg)


def error_message(error: ApiError) -> dict[str, Any]:
    """The message that says why a session ends."""
    return {"type": "error", "error": {"code": error.code, "message": str(error)}}
