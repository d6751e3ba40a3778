"""A page in a headless Chromium, driven over the DevTools protocol."""

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

websocket = pytest.importorskip(
    "websocket", reason="browsing needs websocket-client: pip install websocket-client"
)

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
_PATIENCE_S = 20
_COMPLAINTS = ("error", "warning", "assert")


@contextmanager
def open_page(where: Path | str, profile: Path, flags: Sequence[str] = ()):
    """Open the page of a file or an address; `profile` is an empty folder for the browser's state."""
    program = next((found for name in _PROGRAMS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"browsing needs one of {', '.join(_PROGRAMS)}, none of which is installed")
    always = ("--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--remote-allow-origins=*")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [program, *always, *flags, f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(command, **quiet)
    try:
        page = Page(_address(process, profile / "DevToolsActivePort"))
        try:
            page.open(where)
            yield page
        finally:
            page.close()
    finally:
        process.terminate()
        process.wait(_PATIENCE_S)


def _address(process: subprocess.Popen, port_file: Path) -> str:
    """Wait until the browser listens; return its address."""
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline and process.poll() is None:
        lines = port_file.read_text().split("\n") if port_file.exists() else []
        if len(lines) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        time.sleep(0.02)
    raise AssertionError("the browser did not start")


class Page:
    """A page and its events."""

    def __init__(self, address: str) -> None:
        self._socket = websocket.create_connection(address, timeout=_PATIENCE_S)
        self._count = 0
        self._session = None
        self.events: list[dict] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params) -> dict:
        """Send a command and wait for its result; other messages are appended to `events`."""
        self._count += 1
        session = {"sessionId": self._session} if self._session else {}
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params, **session}))
        while True:
            message = json.loads(self._socket.recv())
            if message.get("id") == self._count:
                assert "error" not in message, message["error"]
                return message["result"]
            self.events.append(message)

    def open(self, where: Path | str) -> None:
        """Open a file or an address and wait until it is loaded and drawn."""
        seen = len(self.events)
        self.send("Page.navigate", url=where.absolute().as_uri() if isinstance(where, Path) else where)
        while not any(event["method"] == "Page.loadEventFired" for event in self.events[seen:]):
            self.events.append(json.loads(self._socket.recv()))
        self.settle()

    def prepare(self, script: str) -> None:
        """Run a script at the beginning of every page that is opened from now on."""
        self.send("Page.addScriptToEvaluateOnNewDocument", source=script)

    def settle(self) -> None:
        """Wait until pending changes are drawn."""
        frame = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.send("Runtime.evaluate", expression=frame, awaitPromise=True)

    def run(self, script: str):
        """The value of an expression on the page, or of its promise."""
        found = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, script: str, patience_s: float = _PATIENCE_S) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + patience_s
        while not self.run(script):
            assert time.monotonic() < deadline, f"{script} did not become true; {self.complaints()}"
            time.sleep(0.02)

    def resize(self, width: int, height: int, *, mobile: bool = False) -> None:
        """Resize the window."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        self.settle()

    def prefer(self, scheme: str) -> None:
        """Prefer "light" or "dark" colors."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.send("Emulation.setEmulatedMedia", features=features)
        self.settle()

    def middle(self, selector: str) -> tuple[float, float]:
        """Scroll to an element; return the position of its center in the window."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{element}.scrollIntoView({{block: 'center'}})")
        x, y, width, height = self.run(
            f"(r => [r.x, r.y, r.width, r.height])({element}.getBoundingClientRect())"
        )
        return x + width / 2, y + height / 2

    def mouse(self, kind: str, x: float, y: float, *, down: bool = False) -> None:
        """Move, press or release the mouse."""
        button = {"button": "left", "clickCount": 1} if down or kind != "Moved" else {}
        self.send("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, buttons=int(down), **button)

    def hover(self, selector: str) -> None:
        """Point at the center of an element."""
        self.mouse("Moved", *self.middle(selector))
        self.settle()

    def click(self, selector: str) -> None:
        """Click on the center of an element."""
        x, y = self.middle(selector)
        self.mouse("Moved", x, y)
        self.mouse("Pressed", x, y, down=True)
        self.mouse("Released", x, y)
        self.settle()

    def drag(self, selector: str, dx: float, dy: float) -> None:
        """Drag from the center of an element."""
        x, y = self.middle(selector)
        self.mouse("Pressed", x, y, down=True)
        for share in (0.5, 1.0):
            self.mouse("Moved", x + share * dx, y + share * dy, down=True)
        self.mouse("Released", x + dx, y + dy)
        self.settle()

    def press(self, key: str) -> None:
        """Press a key on the focused element."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key)
        self.settle()

    def pixels(self, selector: str) -> np.ndarray:
        """Content of a canvas, RGBA."""
        data = self.run(f"document.querySelector({json.dumps(selector)}).toDataURL()").partition(",")[2]
        with Image.open(BytesIO(base64.b64decode(data))) as image:
            return np.array(image.convert("RGBA"))

    def screenshot(self) -> np.ndarray:
        """Content of the window, RGB."""
        data = self.send("Page.captureScreenshot", format="png")["data"]
        with Image.open(BytesIO(base64.b64decode(data))) as image:
            return np.array(image.convert("RGB"))

    def complaints(self) -> list[str]:
        """Errors and warnings of the page or the browser."""
        found = []
        for event in self.events:
            method, params = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                found.append(str(params["exceptionDetails"]))
            if method == "Runtime.consoleAPICalled" and params["type"] in _COMPLAINTS:
                found.append(str(params["args"]))
            if method == "Log.entryAdded" and params["entry"]["level"] in _COMPLAINTS:
                found.append(params["entry"]["text"])
        return found

    def requests(self) -> list[str]:
        """Requested addresses, except for data URIs."""
        sent = [one["params"] for one in self.events if one["method"] == "Network.requestWillBeSent"]
        addresses = [params["request"]["url"] for params in sent]
        return [address for address in addresses if not address.startswith("data:")]

    def close(self) -> None:
        """End the session."""
        self._socket.close()
