"""Queries in the live view: choose one, see it, localize it against the map that is shown."""

from pathlib import Path

import numpy as np
import pycolmap
import viser

from slimsfm.errors import ImageError, SlimsfmError
from slimsfm.localization import Localization, LocalizationOptions, Localizer, Seconds
from slimsfm.localization.cameras import FocalLength, query_camera
from slimsfm.photos import list_images, read_image, shrink
from slimsfm.report.live import MAX_PHOTO_PX, LiveView, plain
from slimsfm.report.live_stage import QUERY_RGB

_NO_IMAGE = np.zeros((1, 1, 3), np.uint8)


class QueryPanel:
    """The list of queries, the button that localizes, and what came of it."""

    def __init__(
        self,
        view: LiveView,
        folder: Path,
        given: pycolmap.Camera | None = None,
        focal: FocalLength = "known",
    ) -> None:
        """Add the queries of a folder to a view.

        Args:
            view: Where they are shown.
            folder: Of images.
            given: Intrinsics of the queries; else the map's or EXIF's.
            focal: How well their focal length is known.

        Raises:
            InputError: The folder does not exist or holds no image.
        """
        self._view, self._folder, self._given = view, folder, given
        self._options = LocalizationOptions(focal=focal)
        self._localizers: dict[str, Localizer] = {}
        self._frustums: dict[str, viser.CameraFrustumHandle] = {}
        gui = view.server.gui
        with gui.add_folder("Query"):
            self.names = gui.add_dropdown("Image", list_images(folder))
            self.preview = gui.add_image(_NO_IMAGE)
            self.button = gui.add_button("Localize", color=QUERY_RGB)
            self.told = gui.add_markdown("")
        self.names.on_update(lambda _: self._choose())
        self.button.on_click(lambda _: self._localize())
        self._choose()

    def _choose(self) -> None:
        """Show the chosen query."""
        try:
            self.preview.image = shrink(read_image(self._folder / self.names.value), MAX_PHOTO_PX)
            self.told.content = ""
        except ImageError as error:
            self.preview.image = _NO_IMAGE
            self.told.content = plain(str(error))

    def _localize(self) -> None:
        """Localize the chosen query, unless one is being localized."""
        if not self._view.busy.acquire(blocking=False):
            return
        name, word = self.names.value, self._view.shown
        try:
            self.button.disabled = True
            self.told.content = f"localizing {plain(name)} …"
            self.told.content = f"**{plain(name)}**, {word.lower()}: {self._outcome(name, word)}"
        except SlimsfmError as error:
            self.told.content = plain(str(error))
        finally:
            self.button.disabled = False
            self._view.busy.release()

    def _outcome(self, name: str, word: str) -> str:
        """Localize a query, show where it was taken and say how sure that is."""
        map_, path = self._view.maps[word].map, self._folder / name
        image, camera = read_image(path), query_camera(map_, path, self._given, self._options.focal)
        if word not in self._localizers:
            self._localizers[word] = Localizer(map_, self._options)
        found = self._localizers[word].localize(image, camera)
        if name in self._frustums:
            self._frustums.pop(name).remove()
        if found.pose is None:
            return f"not localized, {_times(found.seconds)}"
        self._frustums[name] = self._add_frustum(name, found, found.pose.cam_from_world, image)
        sure = f"confidence {found.pose.confidence:.2f}, {found.pose.num_inliers} inliers"
        return f"{sure}, {_times(found.seconds)}"

    def _add_frustum(
        self, name: str, found: Localization, cam_from_world: pycolmap.Rigid3d, image: np.ndarray
    ) -> viser.CameraFrustumHandle:
        photo = shrink(image, MAX_PHOTO_PX)
        stage = self._view.stage
        frustum = stage.add_frustum("/queries", name, found.camera, cam_from_world, QUERY_RGB, photo)
        frustum.on_click(lambda event: stage.look_from(event.client, event.target))
        return frustum


def _times(seconds: Seconds) -> str:
    match_and_pose = seconds.match + seconds.pose
    return f"{1e3 * seconds.extract:.0f} ms for features, {1e3 * match_and_pose:.0f} ms for matching and pose"
