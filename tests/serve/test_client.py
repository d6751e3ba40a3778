"""Clients in Python, and what they say when there is no server."""

import asyncio
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import httpx
import numpy as np
import pycolmap
import pytest
from cryptography import x509

from serving import encoded, photo, served
from slimsfm import AsyncClient, Client
from slimsfm.errors import ImageError, InputError, ServerError
from slimsfm.localization import Localizer
from slimsfm.mapping.io import read_map
from slimsfm.pose import Gravity
from slimsfm.serve.certificates import certificate_for
from slimsfm.serve.options import ServeLimits
from slimsfm.serve.remote import file_of
from slimsfm.serve.running import Binding

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_a_client_gets_the_poses_of_the_library(server, poster, tmp_path):
    localizer, path = Localizer(read_map(poster)), tmp_path / "query.png"
    path.write_bytes(encoded(photo()))
    expected = localizer.localize(photo()).pose
    with Client(server.url) as client:
        for image in (path, str(path), path.read_bytes(), photo()):
            found = client.localize(image, maps=["poster"])
            assert np.array_equal(found.cam_from_world.matrix(), expected.cam_from_world.matrix())
            assert (found.found, found.map, found.confidence) == (True, "poster", expected.confidence)
        assert [one["id"] for one in client.maps()] == ["poster"]
        camera = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[401, 402, 161, 119])
        near = expected.cam_from_world
        gravity = Gravity(in_world=np.array([0.0, 1, 0]), in_cam=near.rotation.matrix() @ [0, 1, 0])
        for given in ({"prior_cam_from_world": near}, {"gravity": gravity}):
            found = client.localize(photo(), camera=camera, **given)
            assert (found.found, found.reply["camera_source"]) == (True, "given")
        nothing = client.localize(np.zeros((64, 64, 3), np.uint8))
        assert (nothing.found, nothing.cam_from_world, nothing.reason) == (
            False,
            None,
            "no matches with the map",
        )


def test_an_asynchronous_client_does_the_same(server):
    async def ask():
        async with AsyncClient(server.url) as client:
            maps, *found = await asyncio.gather(client.maps(), *(client.localize(photo()) for _ in range(3)))
            return maps, found

    maps, found = asyncio.run(ask())
    assert [one["id"] for one in maps] == ["poster"]
    assert len({one.cam_from_world.matrix().tobytes() for one in found}) == 1


def test_what_the_server_refuses_is_an_error_with_its_reason(server, tmp_path):
    with Client(server.url) as client:
        with pytest.raises(ServerError, match="there is no map 'other'") as raised:
            client.localize(photo(), maps=["other"])
        assert (raised.value.status, raised.value.code) == (404, "unknown_map")
        with pytest.raises(ServerError, match="JPEG, PNG or WebP"):
            client.localize(b"text")
        with pytest.raises(ImageError, match="nowhere"):
            client.localize(tmp_path / "nowhere.jpg")
        with pytest.raises(ImageError, match="RGB"):
            client.localize(np.zeros((0, 4, 3), np.uint8))
        with pytest.raises(ValueError, match="PINHOLE"):
            client.localize(photo(), camera=pycolmap.Camera(model="OPENCV", width=320, height=240))


def test_wrong_addresses_are_named():
    for wrong in ("localhost:8000", "ftp://localhost", "http://", "http://[1"):
        with pytest.raises(InputError, match="url"):
            Client(wrong)
    with pytest.raises(ServerError, match="does not answer"), Client("http://127.0.0.1:9") as client:
        client.maps()
    with pytest.raises(InputError, match="nowhere"):
        Client("https://localhost:1", verify="nowhere.pem")


def test_a_client_waits_as_long_as_the_server_asks(poster):
    limits = ServeLimits(requests_per_second=2.0, burst=1)
    with served(poster, limits=limits) as server, Client(server.url) as client:
        assert [client.localize(photo()).found for _ in range(3)] == [True] * 3


def test_others_reach_the_server_by_https_and_with_the_token(poster, tmp_path):
    binding = Binding(host="0.0.0.0", port=0, authority=tmp_path / "authority")
    with served(poster, binding=binding) as server:
        assert server.url.startswith("https://")
        url, _, token = server.url.partition("#token=")
        local = f"https://localhost:{server.address[1]}/"
        with Client(server.url, verify=tmp_path / "authority" / "authority.pem") as client:
            assert client.localize(photo()).found
        with Client(f"{local}#token={token}", verify=tmp_path / "authority" / "authority.pem") as client:
            assert client.maps()
        with pytest.raises(ServerError, match="token"), Client(url, verify=False) as client:
            client.maps()
        with pytest.raises(ServerError, match="certificate"), Client(server.url) as client:
            client.maps()
        fetched = httpx.get(f"{local}authority.crt", verify=False)
        assert fetched.content == (tmp_path / "authority" / "authority.pem").read_bytes()
        assert b"PRIVATE" not in fetched.content
    assert all(one.stat().st_mode & 0o77 == 0 for one in (tmp_path / "authority").iterdir())


def test_the_authority_is_kept_and_phones_can_trust_it(tmp_path):
    first = certificate_for(("192.168.1.2", "fe80::1"), tmp_path / "kept")
    trusted = first.authority.read_bytes()
    second = certificate_for(("10.0.0.7",), tmp_path / "kept")
    assert second.authority.read_bytes() == trusted
    made = x509.load_pem_x509_certificate(second.chain.read_bytes())
    made.verify_directly_issued_by(x509.load_pem_x509_certificate(trusted))
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "10.0.0.7" in map(str, names.get_values_for_type(x509.IPAddress))
    assert (made.not_valid_after_utc - made.not_valid_before_utc).days <= 398
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    (tmp_path / "kept" / "authority.key").write_text("no key")
    with pytest.raises(InputError, match="no usable authority"):
        certificate_for(("10.0.0.7",), tmp_path / "kept")


def test_a_certificate_of_ones_own_is_used(poster, tmp_path):
    own = certificate_for(("localhost",), tmp_path / "own")
    binding = Binding(port=0, cert=own.chain, key=own.key)
    with served(poster, binding=binding) as server, Client(server.url, verify=own.authority) as client:
        assert server.url.startswith("https://localhost:")
        assert client.maps()


def test_the_example_for_ros_converts_messages(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    import ros2_localizer

    matrix = [400.0, 0, 160, 0, 401, 120, 0, 0, 1]
    camera = ros2_localizer.camera_of(SimpleNamespace(k=matrix, width=320, height=240))
    assert (camera.model_name, camera.params.tolist()) == ("PINHOLE", [400, 401, 160, 120])
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9]))
    world_from_cam = pycolmap.Rigid3d(turn, np.array([1.0, 2, 3]))
    message = SimpleNamespace(
        header=SimpleNamespace(),
        pose=SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace()),
    )
    stamped = SimpleNamespace(stamp="now", frame_id="camera")
    filled = ros2_localizer.fill_pose(message, stamped, world_from_cam.inverse(), "poster")
    assert (filled.header.stamp, filled.header.frame_id) == ("now", "poster")
    assert np.allclose([filled.pose.position.x, filled.pose.position.y, filled.pose.position.z], [1, 2, 3])
    orientation = filled.pose.orientation
    found = [orientation.x, orientation.y, orientation.z, orientation.w]
    assert np.allclose(found, world_from_cam.rotation.quat)
    assert "rclpy" not in sys.modules


def test_the_client_needs_no_server_packages():
    unwanted = ("starlette", "uvicorn", "segno", "cryptography")
    code = f"import sys, slimsfm; slimsfm.Client; print([m for m in {unwanted} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (found.stdout, found.stderr) == ("[]\n", "")


def test_an_image_in_memory_is_sent_without_losses():
    noisy = np.random.default_rng(0).integers(0, 255, (64, 48, 3), np.uint8)
    assert np.array_equal(cv2.imdecode(np.frombuffer(file_of(noisy), np.uint8), cv2.IMREAD_COLOR_RGB), noisy)
