"""The HTTP API: poses are the library's, wrong parameters are named, the document is complete."""

import base64
import re
from dataclasses import replace

import httpx
import numpy as np
import pycolmap
import pytest
import trimesh
from starlette.routing import Route

from poster import poster_map
from scenes import exact_map, like_sift
from serving import encoded, photo, served
from slimsfm.localization import Localizer, localize_images
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.io import read_map, write_map
from slimsfm.pose import Gravity
from slimsfm.serve.app import ROUTES
from slimsfm.serve.openapi import ERRORS, OPENAPI


@pytest.fixture(scope="module")
def client(server):
    with httpx.Client(base_url=server.url, timeout=20) as client:
        yield client


@pytest.fixture(scope="module")
def localizer(poster):
    return Localizer(read_map(poster))


def is_same(reply, found):
    pose = found.pose
    assert reply["found"] is True
    assert reply["reason"] is None
    assert reply["cam_from_world"]["quaternion_xyzw"] == pose.cam_from_world.rotation.quat.tolist()
    assert reply["cam_from_world"]["translation"] == pose.cam_from_world.translation.tolist()
    assert (reply["confidence"], reply["inliers"]) == (pose.confidence, pose.num_inliers)
    assert reply["predicted_corner_error"] == found.predicted_corner_error
    assert reply["camera"]["params"] == found.camera.params.tolist()
    assert (reply["camera_source"], reply["camera_estimated"]) == (
        found.camera_source,
        list(found.camera_estimated),
    )
    return True


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_poses_are_those_of_the_library_for_the_same_file(client, localizer, tmp_path, suffix):
    path = tmp_path / f"query{suffix}"
    path.write_bytes(encoded(photo(), suffix))
    reply = client.post("v1/localize", content=path.read_bytes()).json()
    assert is_same(reply, localize_images(localizer, path)[path.name])
    assert reply["predicted_error"] == reply["predicted_corner_error"] * localizer.map.box.diagonal
    assert (reply["map"], reply["unit"]) == ("poster", "unknown")
    assert set(reply["ms"]) == {"receive", "wait", "decode", "extract", "match", "pose", "total"}


def test_intrinsics_prior_and_gravity_are_used_as_the_library_uses_them(client, localizer):
    image, data = photo(), encoded(photo())
    camera = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[400, 400, 160, 120])
    params = {"fx": 400, "fy": 400, "cx": 160, "cy": 120}
    reply = client.post("v1/localize", content=data, params=params).json()
    assert is_same(reply, localizer.localize(image, camera))

    reply = client.post("v1/localize?focal=unknown", content=data).json()
    assert reply["camera_source"] == "unknown"
    assert reply["camera_estimated"] == ["focal length"]

    near = localizer.localize(image).pose.cam_from_world
    prior = ",".join(map(repr, [*near.rotation.quat.tolist(), *near.translation.tolist()]))
    reply = client.post("v1/localize", content=data, params={"prior": prior}).json()
    assert is_same(reply, localizer.localize_near(image, None, near))

    down = near.rotation.matrix() @ [0, 1, 0]
    params = {"gravity": ",".join(map(repr, down.tolist())), "down": "0,1,0"}
    reply = client.post("v1/localize", content=data, params=params).json()
    gravity = Gravity(in_world=np.array([0.0, 1, 0]), in_cam=down)
    assert is_same(reply, localizer.localize(image, gravity=gravity))


def test_a_wrong_prior_does_not_hide_the_object(client):
    reply = client.post("v1/localize", content=encoded(photo()), params={"prior": "0,0,0,1,5,5,90"}).json()
    assert reply["found"]


def test_an_image_without_the_object_is_an_answer(client):
    answer = client.post("v1/localize", content=encoded(np.full((240, 320, 3), 128, np.uint8)))
    assert answer.status_code == 200
    reply = answer.json()
    assert (reply["found"], reply["cam_from_world"], reply["confidence"]) == (False, None, None)
    assert reply["reason"] == "no matches with the map"


def test_several_maps_are_searched_and_the_surest_pose_is_given(poster, small, tmp_path):
    write_map(like_sift(exact_map()), tmp_path / "other")
    with served(poster, small, tmp_path / "other") as server, httpx.Client(base_url=server.url) as client:
        assert [one["id"] for one in client.get("v1/maps").json()["maps"]] == [
            "poster",
            "small-poster",
            "other",
        ]
        query = {"map": "poster,small-poster"}
        reply = client.post("v1/localize", content=encoded(photo()), params=query).json()
        assert [one["map"] for one in reply["maps"]] == ["poster", "small-poster"]
        assert reply["confidence"] == max(one["confidence"] for one in reply["maps"])


def test_maps_and_their_points_are_described(client, localizer):
    (one,) = client.get("v1/maps").json()["maps"]
    assert client.get("v1/maps/poster").json() == one
    assert one["box"]["corners"] == localizer.map.box.corners.tolist()
    assert one["camera"]["fx"] == 400
    points = client.get("v1/maps/poster/points").json()
    assert points["count"] == len(points["positions"]) == len(points["colors"]) == one["num_points"]
    assert np.allclose(points["positions"], localizer.map.points3D_in_world, atol=1e-4)


WRONG = {
    "fx=nan&fy=400": "fx must be a finite number",
    "fx=inf": "fx must be a finite number",
    "fx=1e300": "fx must be a finite number",
    "fx=": "fx must be a finite number",
    "fx=4_0x": "fx must be a finite number",
    "cx=3&cy=3": "intrinsics need fx",
    "fx=400&cx=3": "cx and cy go together",
    "focal=400": "focal can only be unknown",
    "focal=unknown&fx=400": "either focal=unknown or",
    "prior=1,2,3": "prior must be 7 numbers",
    "prior=0,0,0,0,1,2,3": "must not be zero",
    "gravity=0,0,1": "go together",
    "gravity=0,0,0&down=0,0,1": "must not be zero",
    "fx=400&fx=400": "a parameter is given twice",
    "focus=400": "there is no parameter 'focus'",
}


@pytest.mark.parametrize("query", WRONG)
def test_wrong_parameters_are_named(client, query):
    answer = client.post(f"v1/localize?{query}", content=encoded(photo()))
    assert answer.status_code == 400
    assert answer.json()["error"]["code"] == "bad_parameter"
    assert WRONG[query] in answer.json()["error"]["message"]
    assert answer.json()["request_id"] == answer.headers["x-request-id"]


@pytest.mark.parametrize("query", ["fx=-400", "fx=0", "fx=1e-6", "fx=400&cx=1e8&cy=0"])
def test_impossible_intrinsics_are_refused(client, query):
    answer = client.post(f"v1/localize?{query}", content=encoded(photo()))
    assert (answer.status_code, answer.json()["error"]["code"]) == (422, "bad_camera")


def test_every_path_is_documented_and_every_answer_is_as_documented(client):
    routes = {
        (one.path, method.lower()) for one in ROUTES if isinstance(one, Route) for method in one.methods
    }
    routes = {one for one in routes if one[1] != "head"}
    documented = {(path, method) for path, of in OPENAPI["paths"].items() for method in of}
    assert routes == documented
    assert client.get("openapi.json").json() == OPENAPI
    for path in ("v1/maps", "v1/maps/poster", "v1/maps/poster/points", "healthz"):
        schema = schema_of(f"/{path.replace('poster', '{id}')}", "get")
        check(client.get(path).json(), schema)
    check(client.post("v1/localize", content=encoded(photo())).json(), schema_of("/v1/localize", "post"))
    nothing = client.post("v1/localize", content=encoded(np.zeros((64, 64, 3), np.uint8)))
    check(nothing.json(), schema_of("/v1/localize", "post"))
    check(client.post("v1/localize", content=b"text").json(), OPENAPI["components"]["schemas"]["Error"])
    assert {
        int(one) for of in OPENAPI["paths"].values() for op in of.values() for one in op["responses"]
    } <= {
        200,
        *ERRORS,
    }


def schema_of(path, method):
    return OPENAPI["paths"][path][method]["responses"]["200"]["content"]["application/json"]["schema"]


def check(value, schema):
    """The part of JSON Schema that the document uses."""
    if "$ref" in schema:
        schema = OPENAPI["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]]
    if "anyOf" in schema:
        return check(value, schema["anyOf"][value is None])
    if "enum" in schema:
        assert value in schema["enum"]
        return None
    if "const" in schema:
        assert value == schema["const"]
        return None
    kinds = {"object": dict, "array": list, "string": str, "number": int | float, "integer": int}
    kinds |= {"boolean": bool, "null": type(None)}
    assert isinstance(value, kinds[schema["type"]]), (value, schema)
    if schema["type"] == "array":
        assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**6)
        for one in value[:3]:
            check(one, schema["items"])
    elif "properties" in schema:
        assert set(schema["required"]) <= set(value) <= set(schema["properties"])
        for name, one in value.items():
            check(one, schema["properties"][name])
    return None


def test_metrics_are_prometheus_text(client):
    client.post("v1/localize", content=encoded(photo()))
    lines = client.get("metrics").text.splitlines()
    assert all(re.fullmatch(r"#.*|slimsfm_\w+(\{.*\})? [0-9.e+-]+", line) for line in lines)
    assert any(line.startswith('slimsfm_localizations_total{found="true",map="poster"} ') for line in lines)
    assert any(line.startswith("slimsfm_resident_memory_bytes ") for line in lines)


def test_unknown_paths_and_methods_are_errors_in_json(client):
    assert client.get("v1/nothing").json()["error"]["code"] == "not_found"
    answer = client.get("v1/localize")
    assert (answer.status_code, answer.json()["error"]["code"]) == (405, "method_not_allowed")


def geopose_request(image, **changed):
    reading = {"imageFormat": "PNG", "imageBytes": base64.b64encode(image).decode(), **changed}
    return {"id": "mine", "type": "geopose", "sensors": [], "sensorReadings": {"cameraReadings": [reading]}}


def test_a_map_on_the_earth_gives_poses_on_the_earth(tmp_path):
    place = Georeference(latitude=48.2, longitude=16.37, height=171.0)
    map_ = poster_map()
    write_map(replace(map_, info=replace(map_.info, georeference=place)), tmp_path / "there")
    params = {"model": "PINHOLE", "modelParams": [401, 401, 160, 120]}
    with served(tmp_path / "there") as server, httpx.Client(base_url=server.url, timeout=20) as client:
        assert client.get("v1/maps/there").json()["georeferenced"] is True
        reply = client.post("v1/localize", content=encoded(photo())).json()
        check(reply, schema_of("/v1/localize", "post"))
        answer = client.post("oscp/localize/geopose", json=geopose_request(encoded(photo()))).json()
        check(answer, schema_of("/oscp/localize/geopose", "post"))
        given = client.post("oscp/localize/geopose", json=geopose_request(encoded(photo()), params=params))
        nothing = client.post("oscp/localize/geopose", json=geopose_request(encoded(np.zeros_like(photo()))))
    pose = reply["cam_from_world"]
    rotation = pycolmap.Rotation3d(np.array(pose["quaternion_xyzw"]))
    expected = place.geopose(pycolmap.Rigid3d(rotation, np.array(pose["translation"]))).to_json()
    assert_close(reply["geopose"], expected)
    assert answer["geopose"] == reply["geopose"]
    assert (answer["id"], answer["type"]) == ("mine", "geopose")
    assert answer["accuracy"]["position"] == reply["position_bound_95"]
    assert given.status_code == 200
    assert (nothing.status_code, nothing.json()["error"]["code"]) == (404, "not_found")


def assert_close(one, other):
    for part in ("position", "quaternion"):
        assert one[part] == pytest.approx(other[part], abs=1e-9)


def test_a_request_of_the_geopose_protocol_needs_a_map_on_the_earth(client):
    answer = client.post("oscp/localize/geopose", json=geopose_request(b"x"))
    assert (answer.status_code, answer.json()["error"]["code"]) == (404, "not_georeferenced")
    for wrong in ({}, {"sensorReadings": {"cameraReadings": []}}, [1], geopose_request(b"x", imageBytes="?")):
        answer = client.post("oscp/localize/geopose", json=wrong)
        assert (answer.status_code, answer.json()["error"]["code"]) == (400, "bad_geopose_request")
    raw = client.post("oscp/localize/geopose", json=geopose_request(b"x", imageFormat="RGBA32"))
    assert raw.status_code == 415


def test_the_model_is_given_for_the_first_map(poster, small, tmp_path):
    trimesh.creation.box().export(tmp_path / "cube.glb")
    (tmp_path / "anchor.json").write_text('{"scale": 2, "translation": [0, 0, 1]}')
    files = {"model": tmp_path / "cube.glb", "anchor": tmp_path / "anchor.json"}
    with served(poster, small, **files) as server, httpx.Client(base_url=server.url) as client:
        model = client.get("v1/maps/poster/model").json()
        check(model, schema_of("/v1/maps/{id}/model", "get"))
        other = client.get("v1/maps/small-poster/model")
    corners = np.reshape(model["positions"], (-1, 3))
    assert np.allclose([corners.min(axis=0), corners.max(axis=0)], [[-1, -1, 0], [1, 1, 2]])
    assert (other.status_code, other.json()["error"]["code"]) == (404, "no_model")


def test_a_film_is_given_whole_and_in_parts(poster, tmp_path):
    (tmp_path / "film.webm").write_bytes(bytes(range(200)))
    with served(poster, film=tmp_path / "film.webm") as server, httpx.Client(base_url=server.url) as client:
        assert client.get("v1/maps").json()["film"] is True
        whole, part = client.get("v1/film"), client.get("v1/film", headers={"Range": "bytes=10-19"})
    assert (whole.content, whole.headers["content-type"]) == (bytes(range(200)), "video/webm")
    assert (part.status_code, part.content) == (206, bytes(range(10, 20)))
