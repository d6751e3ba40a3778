"""What attackers send gets the right answer, and others are served meanwhile."""

import asyncio
import json
import socket
import struct
import time
import zlib
from contextlib import ExitStack, suppress
from io import BytesIO
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from serving import encoded, exchanged, frame, hello, photo, received, served, tracking
from slimsfm.serve import connections
from slimsfm.serve.options import ServeLimits

TOKEN = "a-token-of-the-tests"
pytestmark = pytest.mark.usefixtures("client")
LIMITS = ServeLimits(receive_s=1.0, idle_s=1.0, max_sessions=3, requests_per_second=1000.0, burst=1000)


@pytest.fixture(scope="module")
def guarded(poster):
    """A server that asks for a token."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connections, "RECEIVE_S", 1.0)
        with served(poster, token=TOKEN, limits=LIMITS) as found:
            yield found


@pytest.fixture
def client(guarded):
    """A client of that server, who has the token and is still answered in the end."""
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client(base_url=guarded.url.partition("#")[0], headers=headers, timeout=20) as client:
        yield client
        assert client.get("v1/maps").status_code == 200


@pytest.fixture
def localized_in_the_end(client):
    """The client finds his image localized in the end."""
    yield
    assert client.post("v1/localize", content=encoded(photo())).json()["found"]


def code_of(answer):
    assert set(answer.json()) == {"error", "request_id"}
    return answer.status_code, answer.json()["error"]["code"]


@pytest.mark.parametrize("given", ["", "Bearer", "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x"])
def test_only_who_has_the_token_is_answered(guarded, given):
    base = guarded.url.partition("#")[0]
    headers = {"Authorization": given} if given else {}
    for path in ("v1/maps", "v1/maps/poster", "v1/maps/poster/points", "v1/film", "metrics"):
        assert code_of(httpx.get(f"{base}{path}", headers=headers)) == (401, "bad_token")
    assert code_of(httpx.post(f"{base}v1/localize", headers=headers, content=b"x")) == (401, "bad_token")
    assert httpx.get(f"{base}healthz", headers=headers).json() == {"status": "ok"}
    assert TOKEN not in httpx.get(f"{base}openapi.json").text


def test_a_session_needs_the_token(guarded):
    for token in ("", "wrong"):
        with connect(guarded.socket_url) as socket_:
            socket_.send(hello(token=token))
            assert ended(socket_) == (4401, "bad_token")
    with tracking(guarded.socket_url, hello(token=TOKEN)):
        pass
    by_header = {"Authorization": f"Bearer {TOKEN}"}
    with connect(guarded.socket_url, additional_headers=by_header) as socket_:
        socket_.send(hello())
        assert json.loads(socket_.recv(10))["type"] == "welcome"


def ended(socket_):
    """The code with which a session was closed, and that of its error."""
    code = None
    try:
        while True:
            message = json.loads(socket_.recv(15))
            code = message["error"]["code"] if message["type"] == "error" else code
    except ConnectionClosed as closed:
        return closed.rcvd and closed.rcvd.code, code


def request(guarded, head, body=b"", method="POST", path="/v1/localize"):
    host = "{}:{}".format(*guarded.address)
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", f"Authorization: Bearer {TOKEN}", *head]
    return "\r\n".join([*lines, "", ""]).encode() + body


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1]) if answer else 0


def test_a_body_that_says_to_be_too_large_is_refused_before_it_comes(guarded):
    start = time.monotonic()
    answer = exchanged(guarded.address, request(guarded, ["Content-Length: 99999999999"]))
    assert status(answer) == 413
    assert b'"body_too_large"' in answer
    assert time.monotonic() - start < 5


@pytest.mark.usefixtures("localized_in_the_end")
def test_who_sends_a_body_that_nobody_needs_still_reads_the_answer(guarded, client):
    data = bytes(3 * 2**20)
    for _ in range(5):
        assert code_of(client.post("v1/localize?fx=nan", content=data)) == (400, "bad_parameter")
        assert code_of(httpx.post(f"{guarded.url.partition('#')[0]}v1/localize", content=data))[0] == 401
        assert code_of(client.post("v1/localize", content=bytes(9 * 2**20))) == (413, "body_too_large")


@pytest.mark.usefixtures("localized_in_the_end")
def test_an_endless_body_is_cut(guarded):
    chunk = b"10000\r\n" + b"\xff\xd8\xff" + bytes(65533) + b"\r\n"
    with socket.create_connection(guarded.address, 15) as raw:
        raw.sendall(request(guarded, ["Transfer-Encoding: chunked"]))
        sent = 0
        with suppress(ConnectionError, TimeoutError):
            while sent < 64 * 2**20:
                raw.sendall(chunk)
                sent += 65536
        assert sent < 64 * 2**20
        assert status(received(raw)) in (413, 0)  # the answer may be lost with the connection


def test_a_body_shorter_than_it_says_is_not_waited_for(guarded):
    with socket.create_connection(guarded.address, 15) as raw:
        raw.sendall(request(guarded, ["Content-Length: 1000"], b"\xff\xd8\xffshort"))
        start = time.monotonic()
        answer = received(raw)
    assert (status(answer), b'"too_slow"' in answer) == (408, True)
    assert time.monotonic() - start < 5


def test_a_body_longer_than_it_says_is_cut_there(guarded):
    data = encoded(photo())
    answer = exchanged(
        guarded.address, request(guarded, [f"Content-Length: {len(data)}"], data + b"\x00" * 999)
    )
    assert answer.startswith(b"HTTP/1.1 200")
    assert b"HTTP/1.1 400" in answer  # the rest is no request


@pytest.mark.parametrize("length", ["-1", "abc", "1, 2", "+5", "9" * 5000])
def test_lengths_that_are_none_are_refused(guarded, length):
    assert status(exchanged(guarded.address, request(guarded, [f"Content-Length: {length}"]))) in (400, 413)


def test_headers_that_come_byte_by_byte_are_not_waited_for(guarded):
    start = time.monotonic()
    with socket.create_connection(guarded.address, 15) as raw:
        raw.sendall(b"POST /v1/localize HT")
        with suppress(ConnectionError):
            while time.monotonic() - start < 12:
                raw.sendall(b"x")
                time.sleep(0.1)
    assert time.monotonic() - start < 8


@pytest.mark.usefixtures("localized_in_the_end")
def test_many_connections_that_say_nothing_do_not_stop_others(guarded, client):
    with ExitStack() as stack:
        for _ in range(60):
            stack.enter_context(socket.create_connection(guarded.address, 15)).sendall(b"GET / HT")
        assert client.get("v1/maps").status_code == 200


def test_huge_headers_are_refused(guarded):
    assert status(exchanged(guarded.address, request(guarded, [f"X-Long: {'a' * 100_000}"]))) in (400, 0)
    many = [f"X-{number}: {'a' * 200}" for number in range(2000)]
    assert status(exchanged(guarded.address, request(guarded, many))) in (400, 0)


@pytest.mark.usefixtures("localized_in_the_end")
def test_garbage_is_no_request(guarded):
    for garbage in (b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", bytes(range(256)) * 40, b"\r\n" * 5000):
        assert status(exchanged(guarded.address, garbage)) in (400, 0)


SMALL = np.zeros((8, 8, 3), np.uint8)


def png_of(width, height, data=b""):
    """A PNG whose header says a size."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def many_scans():
    file = BytesIO()
    Image.fromarray(photo()).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    start = data.rindex(b"\xff\xda")
    return data[:-2] + data[start:-2] * 300 + data[-2:]


IMAGES = {
    "empty": (b"", 400, "empty_body"),
    "text": (b"<html>hello</html>", 415, "not_an_image"),
    "gif": (b"GIF89a" + bytes(100), 415, "not_an_image"),
    "script in a JPEG's clothes": (b"\xff\xd8\xff<script>alert(1)</script>", 422, "bad_image"),
    "random": (b"\xff\xd8\xff" + np.random.default_rng(0).bytes(5000), 422, "bad_image"),
    "truncated JPEG": (encoded(photo(), ".jpg")[:2000], 422, "bad_image"),
    "truncated PNG": (encoded(photo())[:-9000], 422, "bad_image"),
    "truncated WebP": (encoded(photo(), ".webp")[:500], 422, "bad_image"),
    "bomb": (png_of(60_000, 60_000, bytes(3_000_000)), 413, "image_too_large"),
    "a wide one": (png_of(8193, 16), 413, "image_too_large"),
    "many pixels": (png_of(4001, 4001), 413, "image_too_large"),
    "tiny": (encoded(SMALL), 422, "image_too_small"),
    "no pixels": (png_of(0, 0), 422, "bad_image"),
    "many scans": (many_scans(), 422, "bad_image"),
    "EXIF that lies": (
        b"\xff\xd8\xff\xe1\xff\xffExif\x00\x00MM\x00*\xff\xff\xff\xff" + bytes(70_000),
        422,
        "bad_image",
    ),
}


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@pytest.mark.usefixtures("localized_in_the_end")
def test_images_that_are_none_get_a_reason_without_paths(client):
    for name, (data, status_, code) in IMAGES.items():
        answer = client.post("v1/localize", content=data)
        assert (name, *code_of(answer)) == (name, status_, code)
        assert "/" not in answer.json()["error"]["message"]


@pytest.mark.parametrize(
    "kind", ["multipart/form-data; boundary=x", "application/json", "text/plain", "video/mp4"]
)
def test_other_types_of_bodies_are_refused(client, kind):
    answer = client.post("v1/localize", content=encoded(photo()), headers={"Content-Type": kind})
    assert code_of(answer) == (415, "bad_content_type")


def test_foreign_pages_are_refused(guarded, client):
    own = f"http://localhost:{guarded.address[1]}"
    for origin in ("http://evil.example", "null", f"https://evil.example:{guarded.address[1]}", "file://"):
        answer = client.get("v1/maps", headers={"Origin": origin})
        assert code_of(answer) == (403, "bad_origin")
        assert "access-control-allow-origin" not in answer.headers
        with pytest.raises(InvalidStatus, match="403"), connect(guarded.socket_url, origin=origin):
            pass
    assert client.get("v1/maps", headers={"Origin": own}).status_code == 200
    assert client.options("v1/maps", headers={"Origin": "http://evil.example"}).status_code == 403


def test_without_a_token_the_host_must_be_this_machine(server):
    for host in (
        "evil.example",
        f"evil.example:{server.address[1]}",
        "127.0.0.1.evil.example",
        "192.168.1.2",
    ):
        answer = httpx.get(f"{server.url}v1/maps", headers={"Host": host})
        assert code_of(answer) == (403, "bad_host")
    assert httpx.get(f"{server.url}v1/maps", headers={"Host": "127.0.0.1:1"}).status_code == 200
    assert httpx.get(f"{server.url}v1/maps", headers={"Host": '"><script>'}).status_code in (400, 403)


def test_foreign_pages_are_allowed_by_name_alone(poster):
    friend = "https://friend.example"
    with served(poster, origins=(friend,)) as open_, httpx.Client(base_url=open_.url) as client:
        asked = client.options(
            "v1/localize", headers={"Origin": friend, "Access-Control-Request-Method": "POST"}
        )
        assert (asked.status_code, asked.headers["access-control-allow-origin"]) == (204, friend)
        assert client.get("v1/maps", headers={"Origin": friend}).headers["vary"] == "Origin"
        assert client.get("v1/maps", headers={"Origin": "https://friend.example.evil"}).status_code == 403


@pytest.mark.parametrize(
    "name",
    ["..", "../poster", "%2e%2e%2fposter", "..%5cposter", "poster%00", "/etc/passwd", "a" * 5000, "<b>"],
)
def test_ids_of_maps_are_no_paths(guarded, client, name):
    raw = exchanged(
        guarded.address, request(guarded, ["Connection: close"], method="GET", path=f"/v1/maps/{name}/points")
    )
    assert status(raw) in (400, 404)
    assert client.post("v1/localize", params={"map": name}, content=b"").status_code in (400, 404)
    page = exchanged(
        guarded.address, request(guarded, ["Connection: close"], method="GET", path=f"/page/{name}")
    )
    assert status(page) in (400, 404)


def test_answers_forbid_scripts_of_others(client):
    answer = client.get("v1/maps")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "server" not in answer.headers


MESSAGES = {
    "short": b"\x01\x01",
    "empty": b"",
    "header alone": struct.pack("<BBHId", 1, 1, 0, 0, 0.0),
    "version": struct.pack("<BBHId", 9, 1, 0, 0, 0.0) + b"\xff\xd8\xff",
    "orientation": struct.pack("<BBHId", 1, 9, 0, 0, 0.0) + b"\xff\xd8\xff",
    "time": struct.pack("<BBHId", 1, 1, 0, 0, float("nan")) + b"\xff\xd8\xff",
    "no JPEG": struct.pack("<BBHId", 1, 1, 0, 0, 0.0) + encoded(photo()),
    "half a JPEG": frame()[:3000],
    "text": "hello again",
    "deep": "[" * 9000,
    "wrong hello": hello(token=TOKEN, width=10**9),
    "NaN": hello(token=TOKEN, camera={"fx": float("nan")}),
    "no numbers": hello(token=TOKEN, camera={"fx": "a"}),
    "impossible camera": hello(token=TOKEN, camera={"fx": -1}),
    "too many maps": hello(token=TOKEN, maps=["poster"] * 101),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_messages_that_are_no_frames_end_the_session(guarded, name):
    with tracking(guarded.socket_url, hello(token=TOKEN)) as socket_:
        socket_.send(MESSAGES[name])
        assert ended(socket_)[0] == 4400


def test_an_unknown_map_ends_the_session(guarded):
    with connect(guarded.socket_url) as socket_:
        socket_.send(hello(token=TOKEN, maps=["../poster"]))
        assert ended(socket_) == (4404, "unknown_map")


def test_frames_that_are_too_large_end_the_session(guarded):
    with tracking(guarded.socket_url, hello(token=TOKEN)) as socket_, suppress(ConnectionClosed):
        socket_.send(frame() + bytes(9 * 2**20))
        assert ended(socket_)[0] in (1009, None)


def test_sessions_that_say_nothing_end(guarded):
    with tracking(guarded.socket_url, hello(token=TOKEN)) as socket_:
        assert ended(socket_) == (4408, "idle")


@pytest.mark.usefixtures("localized_in_the_end")
def test_a_flood_of_sessions_is_refused_and_leaves_nothing(guarded):
    with ExitStack() as stack:
        for _ in range(LIMITS.max_sessions):
            stack.enter_context(tracking(guarded.socket_url, hello(token=TOKEN)))
        for _ in range(20):
            with connect(guarded.socket_url) as socket_:
                assert ended(socket_) == (4429, "too_many_sessions")
    until = time.monotonic() + 5
    while guarded.server.service.sessions.count and time.monotonic() < until:
        time.sleep(0.02)
    assert guarded.server.service.sessions.count == 0


def test_who_sends_too_fast_is_told_to_wait(poster):
    limits = ServeLimits(requests_per_second=1.0, burst=3)
    with served(poster, limits=limits) as server, httpx.Client(base_url=server.url) as client:
        answers = [client.post("v1/localize", content=b"x") for _ in range(5)]
        assert [one.status_code for one in answers] == [415, 415, 415, 429, 429]
        assert int(answers[-1].headers["retry-after"]) >= 1


def test_what_would_be_late_is_refused_at_once(poster):
    limits = ServeLimits(workers=1, max_waiting=2, requests_per_second=1000.0, burst=1000)

    async def flood(url):
        async with httpx.AsyncClient(base_url=url, timeout=30) as client:
            data = encoded(cv2.resize(photo(), (1600, 1200)))
            return await asyncio.gather(*(client.post("v1/localize", content=data) for _ in range(12)))

    with served(poster, limits=limits) as server:
        answers = asyncio.run(flood(server.url))
        refused = [one for one in answers if one.status_code == 503]
        assert {one.status_code for one in answers} == {200, 503}
        assert all(int(one.headers["retry-after"]) >= 1 for one in refused)
        assert code_of(refused[0]) == (503, "overloaded")
        assert httpx.post(f"{server.url}v1/localize", content=encoded(photo()), timeout=20).status_code == 200


@pytest.mark.usefixtures("localized_in_the_end")
def test_clients_that_leave_leave_nothing(guarded):
    data = encoded(photo())
    for _ in range(10):
        with socket.create_connection(guarded.address, 15) as raw:
            raw.sendall(request(guarded, [f"Content-Length: {len(data)}"], data))
    until = time.monotonic() + 10
    while guarded.server.service.pool.waiting and time.monotonic() < until:
        time.sleep(0.02)
    assert guarded.server.service.pool.waiting == 0


def test_images_are_kept_only_if_asked(poster, tmp_path):
    data = encoded(photo())
    with served(poster, record=tmp_path / "kept") as server, httpx.Client(base_url=server.url) as client:
        reply = client.post("v1/localize", content=data).json()
    (image,) = (tmp_path / "kept").glob("*.png")
    assert image.read_bytes() == data
    kept = json.loads(image.with_suffix(".json").read_text())
    assert kept["cam_from_world"] == reply["cam_from_world"]
    assert (tmp_path / "kept").stat().st_mode & 0o777 == 0o700
    assert image.stat().st_mode & 0o777 == 0o600
    assert not list(Path("/dev/shm").glob("image*"))
