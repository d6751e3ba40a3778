"""A server of maps in this process, and raw connections to it."""

import json
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
from websockets.sync.client import connect

from poster import poster_photo, poster_pose
from slimsfm.serve.options import ServeOptions
from slimsfm.serve.running import Binding, MapServer, silence_uvicorn

EYES = [(0.2, -0.1, -3.1), (0.25, -0.08, -3.1), (0.3, -0.05, -3.05), (0.35, -0.02, -3.0)]
"""Where a camera moves along that no photo of the poster's map was taken from."""


@dataclass(frozen=True)
class Served:
    server: MapServer
    url: str

    @property
    def address(self) -> tuple[str, int]:
        parts = urlsplit(self.url)
        return parts.hostname or "", parts.port or 0

    @property
    def socket_url(self) -> str:
        return self.url.partition("#")[0].replace("http", "ws", 1) + "v1/track"


@contextmanager
def served(*maps: Path, binding: Binding = Binding(port=0), **options: Any) -> Iterator[Served]:
    silence_uvicorn()
    server = MapServer(ServeOptions(maps=maps, **options), binding)
    started = threading.Event()
    thread = threading.Thread(target=server.run, args=(started.set,))
    thread.start()
    try:
        assert started.wait(20)
        yield Served(server, server.urls[0])
    finally:
        server.stop()
        thread.join(20)
        assert not thread.is_alive()


def photo(index: int = 0) -> np.ndarray:
    return poster_photo(poster_pose(EYES[index]))


def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def hello(**changed: Any) -> str:
    said = {"type": "hello", "version": 1, "maps": [], "width": 320, "height": 240, "camera": "map"}
    return json.dumps({**said, **changed})


def frame(index: int = 0, sequence: int = 0, orientation: int = 1) -> bytes:
    return struct.pack("<BBHId", 1, orientation, 0, sequence, 1e3 * sequence) + encoded(photo(index), ".jpg")


@contextmanager
def tracking(url: str, said: str | None = None) -> Iterator[Any]:
    """A connection after its hello, and its welcome."""
    with connect(url, max_size=None, open_timeout=20, close_timeout=5) as client:
        client.send(said or hello())
        welcome = json.loads(client.recv(20))
        assert welcome["type"] == "welcome"
        yield client


def exchanged(address: tuple[str, int], sent: bytes, timeout_s: float = 15) -> bytes:
    """All bytes that come back until the server closes the connection."""
    with socket.create_connection(address, timeout_s) as raw:
        raw.sendall(sent)
        return received(raw)


def received(raw: socket.socket) -> bytes:
    found = b""
    try:
        while part := raw.recv(65536):
            found += part
    except ConnectionError:
        pass
    return found
