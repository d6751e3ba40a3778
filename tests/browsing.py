"""A live view, and a browser that clicks in it, over the websocket that a real one would use."""

import time
from contextlib import contextmanager

import pytest

viser = pytest.importorskip("viser", reason="the live view needs viser: pip install 'slimsfm[view]'")

import msgspec  # noqa: E402 - comes with viser
from websockets.sync.client import connect  # noqa: E402 - comes with viser

from slimsfm.report.live import LiveView, WeighedMap, live_view  # noqa: E402

PATIENCE_S = 20


@contextmanager
def opened(full, reduced=None):
    """The view of these maps, of 24 MB each, on a free port."""
    maps = [WeighedMap(map=one, num_bytes=24_000_000) for one in (full, reduced) if one]
    with live_view(*maps, port=0) as view:
        yield view


@contextmanager
def browsing(view):
    browser = Browser(view)
    try:
        yield browser
    finally:
        browser.close()


def wait_until(reached):
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Browser:
    def __init__(self, view: LiveView) -> None:
        self._view = view
        self._socket = connect(
            view.address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            max_queue=None,
        )
        pose = {"wxyz": (1, 0, 0, 0), "position": (3, 3, 3), "look_at": (0, 0, 0), "up_direction": (0, 0, 1)}
        lens = {"fov": 1.0, "near": 0.01, "far": 1e3, "image_height": 480, "image_width": 640}
        self._send("ViewerCamera", **pose, **lens)
        wait_until(view.server.get_clients)

    @property
    def camera(self):
        (client,) = self._view.server.get_clients().values()
        return client.camera

    def click(self, node):
        ray = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "screen_pos": (0.5, 0.5)}
        self._send("SceneNodeClick", name=node.name, instance_index=None, modifier=None, owner="", **ray)

    def press(self, button):
        self._set(button, True)

    def choose(self, dropdown, option):
        self._set(dropdown, option)
        wait_until(lambda: dropdown.value == option)

    def close(self):
        self._socket.close()

    def _set(self, part, value):
        self._send("GuiUpdate", uuid=part._impl.uuid, updates={"value": value})

    def _send(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": f"{kind}Message", **fields}))
