"""A map in the browser, live: a server that shows a map, before and after it was reduced.

Requires viser, which the extra `view` installs.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path
from threading import Lock

import pycolmap
import viser

from slimsfm.arrays import Image
from slimsfm.errors import InputError
from slimsfm.files import inside
from slimsfm.geometry import corner_error
from slimsfm.image_files import list_images
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.localization.cameras import FocalLength, query_camera
from slimsfm.mapping.map import Map
from slimsfm.photos import Orientation, read_image, shrink
from slimsfm.progress import ProgressBar, silent
from slimsfm.report.access import Access, serving
from slimsfm.report.live_panel import AFTER, BEFORE, MAX_PHOTO_PX, ViewerPanel
from slimsfm.report.scene3d import Scene3D, build_scene3d

_SAME_POSE = 1e-3  # largest corner error between equal poses


@dataclass(frozen=True, kw_only=True, eq=False)
class MapWithSize:
    """A map and its size."""

    map: Map
    """The map."""

    num_bytes: int
    """Size on disk."""


@dataclass(frozen=True, kw_only=True)
class LiveQueries:
    """Images that viewers can localize."""

    folder: Path
    """Folder of images."""

    camera: pycolmap.Camera | None = None
    """Intrinsics of the images; chosen by `query_camera` if not given."""

    focal: FocalLength = "auto"
    """How far the focal length is believed, see `LocalizationOptions.focal`."""

    @cached_property
    def names(self) -> list[str]:
        """Names of the images in the folder."""
        return list_images(self.folder)

    def read(self, name: str, orientation: Orientation = "upright") -> Image:
        """Read an image.

        Raises:
            ImageError: The image is missing or unreadable.
        """
        return read_image(inside(self.folder, name), orientation)


@contextmanager
def live_view(
    full: MapWithSize,
    reduced: MapWithSize | None = None,
    queries: LiveQueries | None = None,
    *,
    host: str = "localhost",
    port: int = 8080,
) -> Iterator["LiveView"]:
    """Serve a view of a map, and of a map reduced from it, within the context.

    Args:
        full: The map.
        reduced: A map that was reduced from it.
        queries: Images to localize.
        host: Address or name that browsers connect to; 0.0.0.0 serves on all addresses of this machine.
            Beyond this machine, `LiveView.address` holds a token, without which nobody can connect.
        port: Port of the host; 0 picks a free one.

    Raises:
        InputError: The port is not available, the maps have no common frame, or there is no query image.
    """
    if reduced:
        check_same_frame(full.map, reduced.map)
    address = _free_address(host, port)
    access = Access.to(address)
    # viser prints when it starts and stops
    with redirect_stdout(StringIO()), serving(access):
        server = viser.ViserServer(host=address, port=port, label="slimsfm", verbose=False)
    try:
        if port not in (0, server.get_port()):  # viser falls back to the next port
            raise InputError(f"port {port} is in use; choose another port")
        view = LiveView(server, full, reduced, queries, token=access.token)
        try:
            yield view
        finally:
            with view.busy:  # wait for the running localization
                view.viewers.clear()
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def check_same_frame(full: Map, reduced: Map) -> None:
    """Check that a map can have been reduced from another.

    Raises:
        InputError: An image of `reduced` is not in `full`, or has another pose there.
    """
    for name, image in reduced.images.items():
        if name not in full.images:
            raise InputError(f"reduced: its image {name!r} is not in the map; give a map reduced from it")
        poses = image.cam_from_world(), full.images[name].cam_from_world()
        if not corner_error(*poses, full.box) <= _SAME_POSE:
            raise InputError(
                f"reduced: its image {name!r} has another pose in the map; give a map reduced from it"
            )


def _free_address(host: str, port: int) -> str:
    """Resolve a host, and check that the port is available.

    viser would pick another port, or wait forever.

    Raises:
        InputError: The port is not available.
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
    """The maps that are shown, and the viewers: each one has its own scene, panel and state."""

    def __init__(
        self,
        server: viser.ViserServer,
        full: MapWithSize,
        reduced: MapWithSize | None = None,
        queries: LiveQueries | None = None,
        *,
        token: str = "",
    ) -> None:
        self.server = server
        self._token = token
        self.maps = {BEFORE: full, **({AFTER: reduced} if reduced else {})}
        self.scene: Scene3D = build_scene3d(full.map)
        self.queries = queries
        if queries:
            _ = queries.names  # fail before a viewer connects
        self.photos: dict[str, Image] = {}
        self.viewers: dict[int, ViewerPanel] = {}
        self.busy = Lock()  # held while a query is localized
        self._localizers: dict[str, Localizer] = {}
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    @property
    def address(self) -> str:
        """URL for a browser, with the token if it needs one."""
        host = self.server.get_host().replace("0.0.0.0", "localhost")
        path = f"/{self._token}/" if self._token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}{path}"

    def show_photos(self, folder: Path, progress: ProgressBar = silent) -> int:
        """Show the reference photos in their frusta.

        Args:
            folder: Folder of the photos, by the names of the images.
            progress: Progress callback.

        Returns:
            Number of missing or unreadable photos; their frusta stay empty.
        """
        names = list(self.scene.frusta)
        orientation = next(iter(self.maps.values())).map.info.orientation
        for name in progress(names, "photos"):
            try:
                self.photos[name] = shrink(read_image(inside(folder, name), orientation), MAX_PHOTO_PX)
            except InputError:
                continue
            for viewer in list(self.viewers.values()):
                viewer.frusta[name].image = self.photos[name]
        return len(names) - len(self.photos)

    def localize(self, name: str, shown: str) -> tuple[Image, Localization]:
        """Localize a query with one of the maps; the caller holds `busy`.

        Args:
            name: Name of the image.
            shown: Key of the map.

        Raises:
            SlimsfmError: The image cannot be read, or its focal length must be known but is not.
        """
        assert self.queries is not None
        options = LocalizationOptions(focal=self.queries.focal)
        map_, path = self.maps[shown].map, inside(self.queries.folder, name)
        image = self.queries.read(name, map_.info.orientation)
        camera = query_camera(map_, path, self.queries.camera, options.focal)
        if shown not in self._localizers:
            self._localizers[shown] = Localizer(map_, options)
        return image, self._localizers[shown].localize(image, camera)

    def _connect(self, client: viser.ClientHandle) -> None:
        self.viewers[client.client_id] = ViewerPanel(self, client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        self.viewers.pop(client.client_id, None)
