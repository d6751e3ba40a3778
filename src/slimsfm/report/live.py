"""A map in the browser, live: points, images and box, before and after, and what a click on them does.

Needs viser, which the extra `view` installs.
"""

import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from threading import Lock

import numpy as np
import viser

from slimsfm.errors import ImageError, InputError
from slimsfm.geometry import corner_error
from slimsfm.mapping.map import Map
from slimsfm.photos import read_image, shrink
from slimsfm.progress import ProgressBar, silent
from slimsfm.report.formatting import contents, format_bytes, format_number
from slimsfm.report.live_stage import BOX_RGB, DROPPED_RGB, KEPT_RGB, Stage

MAX_PHOTO_PX = 320
"""Longer side of a photo in a frustum; larger ones are scaled down."""

BEFORE, AFTER = "Before", "After"
"""What the two maps are called."""

_SAME_POSE = 1e-3  # corner error up to which an image stands where it stood
_SHOWN_COLOR, _OTHER_COLOR = "blue", "gray"


@dataclass(frozen=True, kw_only=True, eq=False)
class WeighedMap:
    """A map and its size."""

    map: Map
    """The map."""

    num_bytes: int
    """What it takes on disk."""


@contextmanager
def live_view(
    full: WeighedMap, reduced: WeighedMap | None = None, *, host: str = "localhost", port: int = 8080
) -> Iterator["LiveView"]:
    """Serve a view of a map, and of what became of it, as long as the context lasts.

    Args:
        full: The map.
        reduced: A map that was reduced from it.
        host: The address or name that browsers reach; 0.0.0.0 is any of this machine's.
        port: Of this address; 0 is one that is free.

    Raises:
        InputError: The port cannot be had, or the maps have no common frame.
    """
    if reduced:
        check_same_frame(full.map, reduced.map)
    address = _free_address(host, port)
    # viser tells of its start and its end by itself
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host=address, port=port, label="slimsfm", verbose=False)
    try:
        if port not in (0, server.get_port()):  # viser goes on to the next one
            raise InputError(f"port {port} is in use; choose another port")
        view = LiveView(server, full, reduced)
        try:
            yield view
        finally:
            view.busy.acquire()  # afterwards there is nobody to be told
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def check_same_frame(full: Map, reduced: Map) -> None:
    """Make sure that a map was made of another.

    Raises:
        InputError: It has an image that the other lacks, or that stands elsewhere there.
    """
    for name, image in reduced.images.items():
        if name not in full.images:
            raise InputError(f"reduced: its image {name!r} is not in the map; give a map reduced from it")
        poses = image.cam_from_world(), full.images[name].cam_from_world()
        if not corner_error(*poses, full.box) <= _SAME_POSE:
            raise InputError(
                f"reduced: its image {name!r} stands elsewhere in the map; give a map reduced from it"
            )


def _free_address(host: str, port: int) -> str:
    """The address of a host, if the port can be had there: viser would evade, or wait without end.

    Raises:
        InputError: It cannot.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"port must be between 0 and 65535, got {port}")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, *_, address = min(found, key=lambda one: one[0] != socket.AF_INET)
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise InputError(
            f"port {port} of {host} cannot be served ({error.strerror}); choose another port or host"
        ) from error
    return str(address[0])


class LiveView:
    """The maps in viser's scene and panel; all who look at it see the same but from where they like."""

    def __init__(self, server: viser.ViserServer, full: WeighedMap, reduced: WeighedMap | None) -> None:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server = server
        self.busy = Lock()  # held while a query is being localized
        self.maps = {BEFORE: full, **({AFTER: reduced} if reduced else {})}
        self.stage = Stage(server, full.map)
        self._groups = {word: self._add_group(word) for word in self.maps}
        self.switch = self._add_switch()
        kept = set(full.map.images) if reduced is None else _images_to_match(reduced.map)
        self.frustums = {name: self._add_image(name, kept=name in kept) for name in full.map.images}
        server.gui.add_markdown(_legend(kept=bool(kept), dropped=len(kept) < len(full.map.images)))
        self.told = server.gui.add_markdown("Click an image to look from where it was taken.")
        self.show(BEFORE)

    @property
    def address(self) -> str:
        """What a browser opens."""
        host = self.server.get_host().replace("0.0.0.0", "localhost")
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def show(self, word: str) -> None:
        """Show the map before or after: its points, and just the images that it has."""
        self.shown = word
        for one, group in self._groups.items():
            group.visible = one == word
        for one, button in self.switch.items():
            button.color = _SHOWN_COLOR if one == word else _OTHER_COLOR

    def show_photos(self, folder: Path, progress: ProgressBar = silent) -> int:
        """Show the reference photos in their frustums.

        Args:
            folder: Where they lie by the names of the images.
            progress: Told how far it is.

        Returns:
            How many are missing or unreadable; their frustums stay empty.
        """
        missing = 0
        for name, frustum in progress(list(self.frustums.items()), "photos"):
            try:
                frustum.image = shrink(read_image(folder / name), MAX_PHOTO_PX)
            except ImageError:
                missing += 1
        return missing

    def _add_group(self, word: str) -> viser.FrameHandle:
        """What is seen of one of the maps alone."""
        group = self.server.scene.add_frame(f"/{word}", show_axes=False)
        self.stage.add_points(f"/{word}", self.maps[word].map)
        return group

    def _add_switch(self) -> dict[str, viser.GuiButtonHandle]:
        texts = {
            word: f"{contents(one.map)}, {format_bytes(one.num_bytes)}" for word, one in self.maps.items()
        }
        if len(texts) == 1:
            self.server.gui.add_markdown(texts[BEFORE])
            return {}
        buttons = {}
        for word, text in texts.items():
            buttons[word] = self.server.gui.add_button(word)
            buttons[word].on_click(partial(self._on_switch, word))
            self.server.gui.add_markdown(text)
        return buttons

    def _on_switch(self, word: str, _event: viser.GuiEvent) -> None:
        self.show(word)

    def _add_image(self, name: str, *, kept: bool) -> viser.CameraFrustumHandle:
        full = self.maps[BEFORE].map
        pose = full.images[name].cam_from_world()
        group, color = ("/images", KEPT_RGB) if kept else (f"/{BEFORE}/images", DROPPED_RGB)
        frustum = self.stage.add_frustum(group, name, full.camera(name), pose, color)
        frustum.on_click(partial(self._look, name))
        return frustum

    def _look(self, name: str, event: viser.SceneNodePointerEvent) -> None:
        self.stage.look_from(event.client, self.frustums[name])
        self.told.content = f"**{plain(name)}**"
        shown = self.maps[self.shown].map
        if name in _images_to_match(shown):
            seen = np.unique(shown.observations[name].points)
            self.told.content += f" sees {format_number(len(seen))} points"


def _images_to_match(map: Map) -> set[str]:
    """Names of the images that queries can be matched with."""
    return set() if map.is_for_direct_matching else set(map.images)


def _legend(*, kept: bool, dropped: bool) -> str:
    parts = [("images kept" if dropped else "images", KEPT_RGB)] if kept else []
    parts += [("images dropped", DROPPED_RGB)] if dropped else []
    parts += [("box", BOX_RGB)]
    return ", ".join(f'<b style="color: rgb{color}">{what}</b>' for what, color in parts)


def plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)
