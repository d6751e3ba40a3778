"""The HTTP API as an OpenAPI document."""

from typing import Any

Json = dict[str, Any]


def _array(items: Json, length: int | None = None) -> Json:
    fixed = {} if length is None else {"minItems": length, "maxItems": length}
    return {"type": "array", "items": items, **fixed}


def _object(properties: Json, optional: tuple[str, ...] = ()) -> Json:
    required = [name for name in properties if name not in optional]
    return {"type": "object", "properties": properties, "required": required}


def _or_null(schema: Json) -> Json:
    return {"anyOf": [schema, {"type": "null"}]}


def _reference(name: str) -> Json:
    return {"$ref": f"#/components/schemas/{name}"}


def _text(description: str) -> Json:
    return {"type": "string", "description": description}


_NUMBER: Json = {"type": "number"}
_COUNT: Json = {"type": "integer", "minimum": 0}
_FLAG: Json = {"type": "boolean"}

_POSE = _object({"quaternion_xyzw": _array(_NUMBER, 4), "translation": _array(_NUMBER, 3)})
_CAMERA = _object(
    {
        "model": _text("Camera model of COLMAP."),
        "width": _COUNT,
        "height": _COUNT,
        **dict.fromkeys(("fx", "fy", "cx", "cy"), _NUMBER),
        "params": _array(_NUMBER),
    }
)
_LOCALIZATION = {
    "found": _FLAG,
    "reason": _or_null(_text("Why there is no pose.")),
    "map": _text("Id of the map."),
    "map_version": _text("Version of the map."),
    "unit": _text("Unit of the map: metre or unknown."),
    "cam_from_world": _or_null(_reference("Pose")),
    "confidence": _or_null({**_NUMBER, "description": "Probability of a corner error below 10 %."}),
    "inliers": _COUNT,
    "predicted_error": _or_null({**_NUMBER, "description": "Mean error of the box's corners, in the unit."}),
    "predicted_corner_error": _or_null({**_NUMBER, "description": "The same over the box's diagonal."}),
    "position_bound_95": _or_null({**_NUMBER, "description": "Holds with 95 % probability, in the unit."}),
    "rotation_bound_95_deg": _or_null({**_NUMBER, "description": "Holds with 95 % probability."}),
    "camera": _reference("Camera"),
    "camera_source": {"enum": ["given", "map", "queries", "exif", "unknown"]},
    "camera_estimated": _array({"type": "string"}),
    "orientation": {"enum": ["upright", "stored"]},
    "geopose": _or_null(_reference("GeoPose")),
}
_MAP = _object(
    {
        "id": _text("Name of the map in requests."),
        "version": _text("Differs if anything in the map differs."),
        "unit": _text("metre or unknown"),
        "box": _object({"corners": _array(_array(_NUMBER, 3), 8), "diagonal": _NUMBER}),
        "attribution": _text("How the map was made."),
        "kind": _text("What the map holds."),
        "num_points": _COUNT,
        "num_images": _COUNT,
        "orientation": {"enum": ["upright", "stored"]},
        "camera": _or_null(_reference("Camera")),
        "georeferenced": _FLAG,
        "model": _FLAG,
    }
)

_SCHEMAS: Json = {
    "Pose": {**_POSE, "description": "cam_from_world: x_in_cam = R @ x_in_world + t."},
    "Camera": _CAMERA,
    "GeoPose": _object(
        {
            "position": _object(dict.fromkeys(("lat", "lon", "h"), _NUMBER)),
            "quaternion": _object(dict.fromkeys("xyzw", _NUMBER)),
        }
    ),
    "GeoPoseResponse": _object(
        {
            "id": {"type": "string"},
            "timestamp": _COUNT,
            "type": {"const": "geopose"},
            "accuracy": _object(dict.fromkeys(("position", "orientation"), _NUMBER)),
            "geopose": _reference("GeoPose"),
        }
    ),
    "Map": _MAP,
    "Maps": _object({"maps": _array(_reference("Map")), "film": _FLAG}),
    "Points": _object(
        {
            "map_version": {"type": "string"},
            "count": _COUNT,
            "positions": _array(_array(_NUMBER, 3)),
            "colors": _array(_array(_COUNT, 3)),
        }
    ),
    "Model": _object(
        {
            **dict.fromkeys(("positions", "normals", "uvs", "colors"), _array(_NUMBER)),
            "indices": _array(_COUNT),
            "texture": _or_null(_text("A data URI.")),
        }
    ),
    "MapResult": _object(_LOCALIZATION),
    "Localization": _object(
        {
            **_LOCALIZATION,
            "ms": {"type": "object", "additionalProperties": _NUMBER},
            "maps": _array(_reference("MapResult")),
            "request_id": {"type": "string"},
        },
        optional=("maps",),
    ),
    "Health": _object({"status": {"type": "string"}}),
    "Error": _object(
        {
            "error": _object({"code": {"type": "string"}, "message": {"type": "string"}}),
            "request_id": {"type": "string"},
        }
    ),
}

ERRORS = {
    400: "A parameter or the request itself is wrong.",
    401: "The token is missing or wrong.",
    403: "The host or the origin is not allowed.",
    404: "There is no such thing.",
    405: "The method is wrong.",
    408: "The body came too slowly.",
    413: "Body or image are too large.",
    415: "The body is not a JPEG, PNG or WebP file.",
    422: "The image is damaged, or the intrinsics are impossible.",
    429: "You send too fast; see Retry-After.",
    503: "Too much waits already; see Retry-After.",
    504: "The request waited longer than its deadline.",
}
"""What each status of an error means."""


def _parameter(name: str, description: str, *, where: str = "query", number: bool = False) -> Json:
    schema = _NUMBER if number else {"type": "string"}
    required = {"required": True} if where == "path" else {}
    return {"name": name, "in": where, "description": description, "schema": schema, **required}


_ID = _parameter("id", "Id of a map.", where="path")
_QUERY = [
    _parameter("map", "Ids of maps, with commas between them; all by default."),
    *(_parameter(name, f"Intrinsics in pixels: {name}.", number=True) for name in ("fx", "fy", "cx", "cy")),
    _parameter("focal", "`unknown`: estimate the focal length, whatever map and EXIF say."),
    _parameter("prior", "About where the camera is, cam_from_world: qx,qy,qz,qw,tx,ty,tz."),
    _parameter("gravity", "Direction of gravity in the camera: x,y,z."),
    _parameter("down", "Direction of gravity in the map: x,y,z."),
]


def _answer(schema: str | None, kind: str = "application/json") -> Json:
    content = {"schema": _reference(schema)} if schema else {}
    return {"description": "The answer.", "content": {kind: content}}


def _operation(summary: str, answer: Json, statuses: tuple[int, ...], **more: Any) -> Json:
    errors = {
        str(status): {**_answer("Error"), "description": ERRORS[status]} for status in (400, 403, *statuses)
    }
    return {"summary": summary, "responses": {"200": answer, **errors}, **more}


_FILE = _answer(None, "application/octet-stream")
_IMAGES = {
    kind: {"schema": {"type": "string", "format": "binary"}}
    for kind in ("image/jpeg", "image/png", "image/webp")
}
_OPEN: Json = {"security": []}

_PATHS: Json = {
    "/": {"get": _operation("The page.", _answer(None, "text/html"), (), **_OPEN)},
    "/page/{name}": {
        "get": _operation(
            "A file of the page.",
            _FILE,
            (404,),
            parameters=[_parameter("name", "Name of the file.", where="path")],
            **_OPEN,
        )
    },
    "/healthz": {"get": _operation("Whether the server answers.", _answer("Health"), (503,), **_OPEN)},
    "/openapi.json": {"get": _operation("This document.", _answer(None), (), **_OPEN)},
    "/authority.crt": {"get": _operation("The certificate to trust.", _FILE, (404,), **_OPEN)},
    "/metrics": {"get": _operation("Counters for Prometheus.", _answer(None, "text/plain"), (401,))},
    "/v1/maps": {"get": _operation("All maps.", _answer("Maps"), (401,))},
    "/v1/maps/{id}": {"get": _operation("One map.", _answer("Map"), (401, 404), parameters=[_ID])},
    "/v1/maps/{id}/points": {
        "get": _operation("Points of a map, 5000 at most.", _answer("Points"), (401, 404), parameters=[_ID])
    },
    "/v1/maps/{id}/model": {
        "get": _operation(
            "The triangle mesh that the page draws.", _answer("Model"), (401, 404), parameters=[_ID]
        )
    },
    "/v1/film": {"get": _operation("The film to play instead of a camera.", _FILE, (401, 404))},
    "/v1/localize": {
        "post": _operation(
            "Find the pose of an image. Not found is an answer, not an error.",
            _answer("Localization"),
            (401, 404, 408, 413, 415, 422, 429, 503, 504),
            parameters=_QUERY,
            requestBody={"required": True, "content": _IMAGES},
        )
    },
    "/oscp/localize/geopose": {
        "post": _operation(
            "Find the pose of an image on the earth, by the Open AR Cloud's GeoPose protocol, version 2.",
            _answer("GeoPoseResponse"),
            (401, 404, 408, 413, 415, 422, 429, 503, 504),
            requestBody={"required": True, "content": {"application/json": {"schema": {"type": "object"}}}},
        )
    },
}

OPENAPI: Json = {
    "openapi": "3.1.0",
    "info": {
        "title": "slimsfm serve",
        "version": "1",
        "description": "Localization of images in small maps.",
    },
    "security": [{"token": []}],
    "paths": _PATHS,
    "components": {
        "schemas": _SCHEMAS,
        "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
    },
}
"""The document."""
