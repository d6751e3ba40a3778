"""Poses on the earth, and the Open AR Cloud's GeoPose protocol as an adapter to localization.

References:
    [1] Open AR Cloud, OSCP GeoPose Protocol, github.com/OpenArCloud/oscp-geopose-protocol.
    [2] OGC 21-056r11, GeoPose 1.0 Data Exchange Standard.
"""

import base64
import binascii
import json
import time
from dataclasses import dataclass
from typing import Any

import pycolmap

from slimsfm.files import plain
from slimsfm.mapping.map import Map
from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.queries import CameraChoice, Intrinsics, intrinsics_of

Json = dict[str, Any]


def geopose_of(map: Map, cam_from_world: pycolmap.Rigid3d) -> Json | None:
    """The pose of a camera on the earth [2], as in `poses.json`; None if the map is not on the earth."""
    place = map.info.georeference
    return None if place is None else place.geopose(cam_from_world).to_json()


@dataclass(frozen=True, kw_only=True, eq=False)
class GeoPoseRequest:
    """A request of the protocol, as far as localization needs it."""

    id: str
    """What the client calls it."""

    image: bytes
    """The picture, JPEG or PNG."""

    camera: CameraChoice
    """Its intrinsics."""


def parse_geopose_request(body: bytes) -> GeoPoseRequest:
    """Parse the body of `POST /oscp/localize/geopose`.

    Raises:
        ApiError: It is not such a request, or has no picture of a supported format (400, 415).
    """
    try:
        data = plain(json.loads(body), dict[str, Any])
        request_id = plain(data.get("id", ""), str)[:200]
        (reading, *_) = plain(data["sensorReadings"]["cameraReadings"], tuple[dict[str, Any], ...])
        image = base64.b64decode(plain(reading["imageBytes"], str), validate=True)
        kind = plain(reading.get("imageFormat", "JPG"), str).upper()
        parameters = plain(reading.get("params") or {}, dict[str, Any])
    except (ValueError, KeyError, TypeError, RecursionError, binascii.Error) as error:
        raise bad_request(
            "bad_geopose_request", f"not a request of the GeoPose protocol: {str(error)[:80]}"
        ) from error
    if kind not in ("JPG", "JPEG", "PNG"):
        raise ApiError(415, "not_an_image", f"imageFormat must be JPG or PNG, got {kind[:20]!r}")
    return GeoPoseRequest(id=request_id, image=image, camera=_camera(parameters))


def _camera(parameters: Json) -> CameraChoice:
    """Intrinsics of COLMAP's models without distortion; the others are not believed."""
    model, values = parameters.get("model"), parameters.get("modelParams")
    names = {"PINHOLE": ("fx", "fy", "cx", "cy"), "SIMPLE_PINHOLE": ("fx", "cx", "cy")}.get(str(model))
    if names is None or not isinstance(values, list) or len(values) != len(names):
        return "map"
    found: Intrinsics = intrinsics_of(dict(zip(names, values, strict=True)))
    return found


def geopose_response(request: GeoPoseRequest, reply: Json) -> Json:
    """The answer of the protocol to a localization.

    Raises:
        ApiError: The object was not found (404).
    """
    if not reply["found"]:
        raise ApiError(404, "not_found", f"the camera was not localized: {reply['reason']}")
    accuracy = {"position": reply["position_bound_95"], "orientation": reply["rotation_bound_95_deg"]}
    return {
        "id": request.id,
        "timestamp": int(1000 * time.time()),
        "type": "geopose",
        "accuracy": accuracy,
        "geopose": reply["geopose"],
    }
