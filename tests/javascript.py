"""The modules of the page, run by node, or else in Chromium."""

import json
import shutil
import subprocess
import threading
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

import slimsfm

PAGE = Path(slimsfm.__file__).parent / "serve" / "page"
_TIMEOUT_S = 60


def run(body: str, **values: Any) -> Any:
    """What a function of JavaScript returns.

    Args:
        body: Statements; `load(name)` is a promise of a module of the page. Values are plain, as in JSON.
        values: Variables of the body; arrays become lists.
    """
    plain = json.dumps(values, default=_plain)
    names = ", ".join(values)
    function = f"(async ({{{names}}}, load) => {{ {body} }})"
    return _by_node(function, plain) if shutil.which("node") else _by_chromium(function, plain)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else list(value)


def _by_node(function: str, values: str) -> Any:
    script = (
        "import { readFileSync } from 'node:fs';"
        f"const load = (name) => import({json.dumps(_modules().as_uri())} + '/' + name);"
        f"const found = await {function}(JSON.parse(readFileSync(0, 'utf8')), load);"
        "process.stdout.write(JSON.stringify(found ?? null));"
    )
    command = ["node", "--input-type=module", "-e", script]
    done = subprocess.run(command, input=values, capture_output=True, text=True, timeout=_TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@cache
def _modules() -> Path:
    """The page's files beside what tells node of any version that they are modules."""
    folder = Path(_keep(TemporaryDirectory()).name)
    shutil.copytree(PAGE, folder / "page")
    (folder / "page" / "package.json").write_text('{"type": "module"}')
    return folder / "page"


_kept: list[Any] = []


def _keep(thing: Any) -> Any:
    _kept.append(thing)
    return thing


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


def _by_chromium(function: str, values: str) -> Any:
    from browser import open_page

    handler = partial(_Quiet, directory=str(_modules()))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, TemporaryDirectory() as profile:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            address = f"http://127.0.0.1:{server.server_port}/icon.svg"
            with open_page(address, Path(profile)) as page:
                return page.run(f"{function}({values}, (name) => import('/' + name))")
        finally:
            server.shutdown()


def needs_a_runtime() -> None:
    """Skip unless JavaScript can be run."""
    if not any(shutil.which(name) for name in ("node", "chromium", "chromium-browser", "google-chrome")):
        pytest.skip("the page's modules need node or Chromium, neither of which is installed")
