"""A live view, and a browser that uses it over the websocket of a real browser."""

import time
from contextlib import contextmanager

import pytest

viser = pytest.importorskip("viser", reason="the live view needs viser: pip install 'slimsfm[view]'")

import msgspec  # noqa: E402 - comes with viser
from websockets.sync.client import connect  # noqa: E402 - comes with viser

from slimsfm.report.live import LiveQueries, LiveView, MapWithSize, live_view  # noqa: E402

PATIENCE_S = 20


@contextmanager
def opened(full, reduced=None, queries=None, **options):
    """A view of these maps, of 24 MB each, on a free port, with a folder of queries."""
    maps = [MapWithSize(map=one, num_bytes=24_000_000) for one in (full, reduced) if one]
    asked = LiveQueries(folder=queries, **options) if queries else None
    with live_view(*maps, queries=asked, port=0) as view:
        yield view


@contextmanager
def browsing(view):
    """A browser that looks at a view."""
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
    """A browser's connection, and the handles of what it shows."""

    def __init__(self, view: LiveView) -> None:
        before = set(view.viewers)
        self._socket = connect(
            view.address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            max_queue=None,
        )
        pose = {"wxyz": (1, 0, 0, 0), "position": (3, 3, 3), "look_at": (0, 0, 0), "up_direction": (0, 0, 1)}
        lens = {"fov": 1.0, "near": 0.01, "far": 1e3, "image_height": 480, "image_width": 640}
        self._send("ViewerCamera", **pose, **lens)
        wait_until(lambda: set(view.viewers) - before)
        (key,) = set(view.viewers) - before
        self.viewer = view.viewers[key]
        self.queries = self.viewer.queries

    @property
    def camera(self):
        return self.viewer.client.camera

    @property
    def scene(self):
        return self.viewer.client.scene

    def click(self, node):
        ray = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "screen_pos": (0.5, 0.5)}
        owner = str(self.viewer.client.client_id)
        self._send("SceneNodeClick", name=node.name, instance_index=None, modifier=None, owner=owner, **ray)

    def press(self, button):
        self.set(button, True)

    def choose(self, dropdown, option):
        self.set(dropdown, option)
        wait_until(lambda: dropdown.value == option)

    def set(self, part, value):
        self._send("GuiUpdate", uuid=part._impl.uuid, updates={"value": value})

    def close(self):
        self._socket.close()

    def _send(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": f"{kind}Message", **fields}))
