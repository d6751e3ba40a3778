"""Only the page of a view may connect to it, and beyond this machine only with its token."""

import http.client
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest

from browser import open_page
from browsing import browsing, opened, viser, wait_until
from slimsfm.errors import InputError
from slimsfm.report import access
from slimsfm.report.live import MapWithSize, live_view

from websockets.exceptions import InvalidStatus  # isort: skip - comes with viser
from websockets.sync.client import connect  # isort: skip


@contextmanager
def served(full, host):
    with live_view(MapWithSize(map=full, num_bytes=1), host=host, port=0) as view:
        yield urlsplit(view.address)


def status_of_page(address, path=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=20)
    try:
        connection.putrequest("GET", address.path if path is None else path, skip_host=True)
        for name, value in {"Host": address.netloc, **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


def status_of_socket(address, path=None, **headers):
    asked = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    own = {
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    }
    return status_of_page(address, path, **asked, **own, **headers)


REQUESTS = {status_of_page: 200, status_of_socket: 101}


@pytest.mark.parametrize("request_status", REQUESTS, ids=["page", "websocket"])
def test_only_the_page_of_the_view_may_connect(full, request_status):
    with served(full, "localhost") as address:
        port = address.port
        own = [{}, {"Origin": f"http://{address.netloc}"}]
        own.append({"Host": "localhost:9000", "Origin": "http://localhost:9000"})  # a forwarded port
        own.append({"Host": f"[::1]:{port}"})
        for headers in own:
            assert request_status(address, **headers) == REQUESTS[request_status]
        for origin in (
            "http://evil.example",
            "null",
            "",
            f"http://localhost:{port + 1}",
            "file://",
            "garbage",
        ):
            assert request_status(address, Origin=origin) == 403
        for host in (
            "evil.example",
            f"evil.example:{port}",
            "127.0.0.1.evil.example",
            "192.168.1.2",
            "",
            "[",
        ):
            assert request_status(address, Host=host) == 403
        rebound = f"evil.example:{port}"
        assert request_status(address, Host=rebound, Origin=f"http://{rebound}") == 403


@pytest.mark.parametrize("request_status", REQUESTS, ids=["page", "websocket"])
def test_beyond_this_machine_the_token_is_required(full, request_status):
    with served(full, "0.0.0.0") as address:
        token = address.path.strip("/")
        assert len(token) >= 20
        for path in (f"/{token}/", f"/{token}", f"/{token}/?a=b"):
            for host in (address.netloc, f"192.168.1.2:{address.port}"):
                there = {"Host": host, "Origin": f"http://{host}"}
                assert request_status(address, path, **there) == REQUESTS[request_status]
        for path in ("/", f"/?{token}", f"/{token[:-1]}/", f"/{token}x", f"//{token}/", f"/x/{token}/"):
            assert request_status(address, path) == 403
        assert request_status(address, Origin="http://evil.example") == 403


def test_a_websocket_of_a_foreign_page_is_closed_before_it_opens(full):
    with opened(full) as view:
        url = view.address.replace("http", "ws")
        with pytest.raises(InvalidStatus, match="403"):
            connect(url, origin="http://evil.example")
        assert view.viewers == {}


def test_each_view_has_its_own_token(full):
    with served(full, "0.0.0.0") as one, served(full, "0.0.0.0") as other:
        assert one.path != other.path
        assert status_of_page(one, other.path) == 403
    assert access.Access.to("127.0.1.1").token == access.Access.to("::1").token == ""
    assert access.Access.to("::").token


def test_a_viser_that_cannot_be_guarded_is_refused():
    with pytest.raises(InputError, match=r"install viser 1\.1"), access.serving(access.Access()):
        pass


def test_a_page_with_a_token_is_used_as_any_other(full):
    with live_view(MapWithSize(map=full, num_bytes=1), host="0.0.0.0", port=0) as view, browsing(view) as one:
        assert list(one.viewer.frusta) == list(full.images)


def test_a_browser_connects_from_the_view_and_not_from_another_page(full, tmp_path):
    (tmp_path / "foreign.html").write_text("<p>foreign</p>")
    ask = "new Promise(done => {{ const s = new WebSocket({}); s.onopen = s.onclose = e => done(e.type); }})"
    with (
        live_view(MapWithSize(map=full, num_bytes=1), host="0.0.0.0", port=0) as view,
        open_page(tmp_path / "foreign.html", tmp_path / "profile") as page,
    ):
        url = view.address.replace("http", "ws")
        asked = {"expression": ask.format(f"'{url}'"), "awaitPromise": True, "returnByValue": True}
        assert page.send("Runtime.evaluate", **asked)["result"]["value"] == "close"
        page.send("Page.navigate", url=view.address)
        wait_until(lambda: view.viewers)
