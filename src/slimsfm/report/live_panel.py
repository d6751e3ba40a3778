"""What one viewer of the live view sees: the scene, and a panel with its controls."""

import re
from functools import partial
from time import sleep
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
import pycolmap
import viser
import viser.transforms

from slimsfm.arrays import Image
from slimsfm.errors import ImageError, SlimsfmError
from slimsfm.evaluation.table import format_bytes, format_number
from slimsfm.geometry import BOX_EDGES
from slimsfm.localization import Seconds
from slimsfm.mapping.map import Map
from slimsfm.photos import shrink
from slimsfm.report.formatting import format_map
from slimsfm.report.scene3d import FRUSTUM_DEPTH, scene_points

if TYPE_CHECKING:
    from slimsfm.report.live import LiveView

RGB = tuple[int, int, int]

BEFORE, AFTER = "Before", "After"
"""Keys and names of the two maps."""

MAX_PHOTO_PX = 320
"""Longer side of a photo in a frustum."""

KEPT_RGB: RGB = (214, 35, 31)
"""Color of reference images that are kept."""

DROPPED_RGB: RGB = (127, 130, 141)
"""Color of reference images that the reduced map lacks."""

QUERY_RGB: RGB = (18, 150, 66)
"""Color of localized queries."""

BOX_RGB: RGB = (34, 104, 216)
"""Color of the object's box."""

_POINT_SIZE = 0.003  # relative to the box's diagonal
_IN_FRONT = 1.05  # position of the viewer, in depths of a frustum: in front of the photo
_LINE_PX = 2.0
_FIRST_VIEW = np.array([1.0, 0.4, 0.6])  # direction of the first view; x is toward the cameras
_FIRST_DISTANCE = 1.7  # of the first view, relative to that of the cameras
_FLIGHT_S, _FLIGHT_STEPS = 0.6, 20
_SHOWN_COLOR, _OTHER_COLOR = "blue", "gray"
_NO_IMAGE = np.zeros((1, 1, 3), np.uint8)


class ViewerPanel:
    """Scene and controls of one viewer."""

    def __init__(self, view: "LiveView", client: viser.ClientHandle) -> None:
        self._view, self.client = view, client
        self._scene = view.scene
        self._depth = FRUSTUM_DEPTH * self._scene.camera_distance
        self._groups = {
            key: client.scene.add_frame(f"/{key}", show_axes=False, visible=key == BEFORE)
            for key in view.maps
        }
        self.shown = BEFORE
        self.points = {key: self._add_points(key) for key in view.maps}
        corners = self._scene.box[np.array(BOX_EDGES)]
        self.box = client.scene.add_line_segments(
            "/box", corners, BOX_RGB, thickness=_LINE_PX, thickness_units="screen"
        )
        self.descriptions: dict[str, viser.GuiMarkdownHandle] = {}
        self.switch = self._add_switch()
        quality = view.maps[BEFORE].map.info.quality
        self.warnings = [
            client.gui.add_markdown(f"**Warning:** {plain_markdown(warning)}")
            for warning in (quality.warnings if quality else ())
        ]
        self.point_size = client.gui.add_slider("Point size", 0.2, 5.0, 0.1, 1.0)
        self.point_size.on_update(lambda _: self._resize_points())
        kept = _images_to_match(list(view.maps.values())[-1].map) if len(view.maps) > 1 else None
        full = view.maps[BEFORE].map
        self.frusta = {name: self._add_image(name, kept=kept is None or name in kept) for name in full.images}
        num_kept = len(full.images if kept is None else kept)
        client.gui.add_markdown(_legend(kept=num_kept > 0, dropped=num_kept < len(full.images)))
        self.message = client.gui.add_markdown("Click an image to look from its camera.")
        self.queries = QueryControls(view, self) if view.queries else None
        self._look_first()

    @property
    def is_connected(self) -> bool:
        """Whether the viewer is still there."""
        return self.client.client_id in self._view.viewers

    def show(self, key: str) -> None:
        """Show one of the maps: its points, and the images that it has."""
        self.shown = key
        for one, group in self._groups.items():
            group.visible = one == key
        for one, button in self.switch.items():
            button.color = _SHOWN_COLOR if one == key else _OTHER_COLOR

    def add_frustum(
        self,
        node: str,
        camera: pycolmap.Camera,
        cam_from_world: pycolmap.Rigid3d,
        color: RGB,
        photo: Image | None = None,
    ) -> viser.CameraFrustumHandle:
        """Show the pose of an image, without distortion.

        Args:
            node: Name of the scene's node.
            camera: Intrinsics of the image.
            cam_from_world: Its pose.
            color: Of the lines.
            photo: The image, small.
        """
        K, frame = camera.calibration_matrix(), self._scene.frame
        half_width, half_height = camera.width / (2 * K[0, 0]), camera.height / (2 * K[1, 1])
        view_from_cam = frame.rotation @ cam_from_world.rotation.inverse().matrix()
        return self.client.scene.add_camera_frustum(
            node,
            fov=float(2 * np.arctan(half_height)),
            aspect=half_width / half_height,
            # viser divides by this root, which scales all frusta to one volume
            scale=self._depth * float(np.cbrt(half_width * half_height / 3)),
            thickness=_LINE_PX,
            thickness_units="screen",
            color=color,
            image=photo,
            wxyz=viser.transforms.SO3.from_matrix(view_from_cam).wxyz,
            position=frame.apply(cam_from_world.inverse().translation[None])[0],
        )

    def fly_to(self, frustum: viser.CameraFrustumHandle) -> None:
        """Move the viewer to a camera, in front of its photo, to orbit around what the camera looks at."""
        camera = self.client.camera
        axis = viser.transforms.SO3(frustum.wxyz).as_matrix()[:, 2]
        look_at = frustum.position + max(float(-frustum.position @ axis), 2 * self._depth) * axis
        position = frustum.position + _IN_FRONT * self._depth * axis
        starts = np.array([camera.position, camera.look_at])
        start, end = viser.transforms.SO3(camera.wxyz), viser.transforms.SO3(frustum.wxyz)
        turn = (start.inverse() @ end).log()
        for step in range(1, _FLIGHT_STEPS + 1):
            if not self.is_connected:
                return
            share = step / _FLIGHT_STEPS
            share = share * share * (3 - 2 * share)
            with self.client.atomic():
                camera.position, target = starts + share * (np.array([position, look_at]) - starts)
                camera.wxyz = (start @ viser.transforms.SO3.exp(share * turn)).wxyz
                camera.look_at = target
            sleep(_FLIGHT_S / _FLIGHT_STEPS)
        with self.client.atomic():
            camera.position, camera.wxyz, camera.look_at = position, frustum.wxyz, look_at

    def _look_first(self) -> None:
        direction = _FIRST_VIEW / np.linalg.norm(_FIRST_VIEW)
        with self.client.atomic():
            self.client.camera.up_direction = np.array([0.0, 0.0, 1.0])
            self.client.camera.position = _FIRST_DISTANCE * self._scene.camera_distance * direction
            self.client.camera.look_at = np.zeros(3)

    def _add_points(self, key: str) -> viser.PointCloudHandle:
        positions, colors = scene_points(self._view.maps[key].map, self._scene.frame)
        return self.client.scene.add_point_cloud(
            f"/{key}/points",
            positions,
            colors,
            point_size=_POINT_SIZE,
            point_shape="circle",
            precision="float32",
        )

    def _resize_points(self) -> None:
        for points in self.points.values():
            points.point_size = _POINT_SIZE * self.point_size.value

    def _add_switch(self) -> dict[str, viser.GuiButtonHandle]:
        buttons = {}
        for key, one in self._view.maps.items():
            if len(self._view.maps) > 1:
                color = _SHOWN_COLOR if key == self.shown else _OTHER_COLOR
                buttons[key] = self.client.gui.add_button(key, color=color)
                buttons[key].on_click(lambda _, key=key: self.show(key))
            text = f"{format_map(one.map)}, {format_bytes(one.num_bytes)}"
            self.descriptions[key] = self.client.gui.add_markdown(text)
        return buttons

    def _add_image(self, name: str, *, kept: bool) -> viser.CameraFrustumHandle:
        full = self._view.maps[BEFORE].map
        pose = full.images[name].cam_from_world()
        group, color = ("/images", KEPT_RGB) if kept else (f"/{BEFORE}/images", DROPPED_RGB)
        node, photo = f"{group}/{quote(name, safe='')}", self._view.photos.get(name)
        frustum = self.add_frustum(node, full.camera(name), pose, color, photo)
        frustum.on_click(partial(self._click, name))
        return frustum

    def _click(self, name: str, _event: viser.SceneNodePointerEvent) -> None:
        shown = self._view.maps[self.shown].map
        seen = ""
        if name in _images_to_match(shown):
            seen = f" sees {format_number(len(np.unique(shown.observations[name].points)))} points"
        self.message.content = f"**{plain_markdown(name)}**{seen}"
        self.fly_to(self.frusta[name])


class QueryControls:
    """The list of queries, a button that localizes the chosen one, and the result."""

    def __init__(self, view: "LiveView", viewer: ViewerPanel) -> None:
        assert view.queries is not None
        self._view, self._viewer, self._queries = view, viewer, view.queries
        self._frusta: dict[str, viser.CameraFrustumHandle] = {}
        gui = viewer.client.gui
        with gui.add_folder("Query"):
            self.names = gui.add_dropdown("Image", self._queries.names)
            self.preview = gui.add_image(_NO_IMAGE)
            self.button = gui.add_button("Localize", color=QUERY_RGB)
            self.message = gui.add_markdown("")
        self.names.on_update(lambda _: self._choose())
        self.button.on_click(lambda _: self._localize())
        self._choose()

    def _choose(self) -> None:
        try:
            self.preview.image = shrink(self._queries.read(self.names.value), MAX_PHOTO_PX)
            self.message.content = ""
        except ImageError as error:
            self.preview.image = _NO_IMAGE
            self.message.content = plain_markdown(str(error))

    def _localize(self) -> None:
        if self.button.disabled:
            return
        name = self.names.value
        self.button.disabled = True
        self.message.content = f"localizing {plain_markdown(name)} …"
        with self._view.busy:
            if not self._viewer.is_connected:
                return
            outcome = self._outcome(name)
            if not self._viewer.is_connected:
                return
            self.message.content = outcome
            self.button.disabled = False
        if name in self._frusta:
            self._viewer.fly_to(self._frusta[name])

    def _outcome(self, name: str) -> str:
        """Localize a query, show its pose, and describe it."""
        key = self._viewer.shown
        if name in self._frusta:
            self._frusta.pop(name).remove()
        try:
            image, found = self._view.localize(name, key)
        except SlimsfmError as error:
            return plain_markdown(str(error))
        map_name = f", {key.lower()}" if len(self._view.maps) > 1 else ""
        title = f"**{plain_markdown(name)}**{map_name}"
        if found.pose is None:
            return f"{title}: not localized, {_times(found.seconds)}"
        if self._viewer.is_connected:  # still
            self._show_pose(name, image, found.camera, found.pose.cam_from_world)
        inliers = f"{found.pose.num_inliers} inliers"
        return f"{title}: confidence {found.pose.confidence:.2f}, {inliers}, {_times(found.seconds)}"

    def _show_pose(
        self, name: str, image: Image, camera: pycolmap.Camera, cam_from_world: pycolmap.Rigid3d
    ) -> None:
        node, photo = f"/queries/{quote(name, safe='')}", shrink(image, MAX_PHOTO_PX)
        frustum = self._viewer.add_frustum(node, camera, cam_from_world, QUERY_RGB, photo)
        frustum.on_click(lambda _: self._viewer.fly_to(frustum))
        self._frusta[name] = frustum


def plain_markdown(text: str) -> str:
    """Escape text for Markdown."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def _images_to_match(map: Map) -> set[str]:
    """Names of the images that queries can be matched with."""
    return set() if map.is_for_direct_matching else set(map.images)


def _legend(*, kept: bool, dropped: bool) -> str:
    parts = [("images kept" if dropped else "images", KEPT_RGB)] if kept else []
    parts += [("images dropped", DROPPED_RGB)] if dropped else []
    parts += [("box", BOX_RGB)]
    return ", ".join(f'<b style="color: rgb{color}">{text}</b>' for text, color in parts)


def _times(seconds: Seconds) -> str:
    match_and_pose = seconds.match + seconds.pose
    return f"{1e3 * seconds.extract:.0f} ms for features, {1e3 * match_and_pose:.0f} ms for matching and pose"
