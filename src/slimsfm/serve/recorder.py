"""`--record`: images that clients sent, with their poses, for making maps better."""

import json
import logging
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic

from slimsfm.serve.images import format_of
from slimsfm.serve.replies import Json

_LOGGER = logging.getLogger(__name__)
_LEAST_FREE_BYTES = 2**30
_EVERY_S = 1.0  # between frames of one session
_SUFFIX = {"JPEG": "jpg", "PNG": "png", "WebP": "webp"}


class Recorder:
    """Writes images to a folder; does nothing without one."""

    def __init__(self, folder: Path | None) -> None:
        """Make the folder, which only this user may read."""
        self._folder = folder
        self._last: dict[str, float] = {}
        if folder:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)

    def keep(self, name: str, data: bytes, reply: Json) -> None:
        """Write an image and its answer. A full disk stops the recording, never the server."""
        if self._folder is None:
            return
        try:
            if shutil.disk_usage(self._folder).free < _LEAST_FREE_BYTES:
                raise OSError("less than 1 GiB is free")
            stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")
            path = self._folder / f"{stamp}-{name}.{_SUFFIX[format_of(data)]}"
            _write(path, data)
            _write(path.with_suffix(".json"), json.dumps(reply, indent=1).encode())
        except OSError as error:
            _LOGGER.warning("%s: nothing more is recorded: %s", self._folder, error)
            self._folder = None

    def keep_frame(self, session: str, data: bytes, reply: Json) -> None:
        """Write a frame of a session, at most one a second."""
        if self._folder is None or monotonic() - self._last.get(session, -_EVERY_S) < _EVERY_S:
            return
        self._last = {session: monotonic(), **{key: at for key, at in self._last.items() if key != session}}
        self._last = dict(list(self._last.items())[:256])
        self.keep(session, data, reply)


def _write(path: Path, data: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
