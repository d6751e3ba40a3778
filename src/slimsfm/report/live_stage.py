"""Points, frustums and the object's box in viser's scene, in the frame of `scene3d.view_frame`.

There z is up, where the images' upper edges point, and the diagonal of the box is the unit, as viser's camera
controls expect of a scene.
"""

from urllib.parse import quote

import numpy as np
import pycolmap
import viser
import viser.transforms

from slimsfm.arrays import Image
from slimsfm.geometry import BOX_EDGES
from slimsfm.mapping.map import Map
from slimsfm.report.scene3d import view_frame

RGB = tuple[int, int, int]

KEPT_RGB: RGB = (214, 35, 31)
"""Colour of reference images that are in the map that is shown, or stay in the reduced one."""

DROPPED_RGB: RGB = (127, 130, 141)
"""Colour of reference images that the reduced map lacks."""

QUERY_RGB: RGB = (18, 150, 66)
"""Colour of localized queries."""

BOX_RGB: RGB = (34, 104, 216)
"""Colour of the object's box."""

_FRUSTUM_DEPTH = 0.09  # over the median distance of the cameras from the middle of the box
_POINT_SIZE = 0.006  # of the box's diagonal
_BEFORE_PHOTO = 1.05  # where one looks from, in depths of a frustum: its photo would hide the points
_LINE_PX = 2.0
_FIRST_LOOK = np.array([1.0, 0.4, 0.6])  # whence the view looks at first: x is where the cameras are
_FIRST_DISTANCE = 1.7  # of that place, over the cameras' median distance


class Stage:
    """What is shown stands here; positions are given in the map's frame."""

    def __init__(self, server: viser.ViserServer, full: Map) -> None:
        self.server = server
        poses = [image.cam_from_world() for image in full.images.values()]
        self._frame = view_frame(poses, full.box)
        self._rotation = self._frame.view_from_world * full.box.diagonal
        centers = self._frame.apply(np.array([pose.inverse().translation for pose in poses]))
        distance = float(np.median(np.linalg.norm(centers, axis=1)))
        self._depth = _FRUSTUM_DEPTH * distance
        first = _FIRST_DISTANCE * distance * _FIRST_LOOK / np.linalg.norm(_FIRST_LOOK)
        server.initial_camera.position = first
        server.initial_camera.look_at = np.zeros(3)
        corners = self._frame.apply(full.box.corners)
        server.scene.add_line_segments(
            "/box", corners[np.array(BOX_EDGES)], BOX_RGB, thickness=_LINE_PX, thickness_units="screen"
        )

    def add_points(self, group: str, map: Map) -> None:
        """Show the points of a map in their colours."""
        self.server.scene.add_point_cloud(
            f"{group}/points",
            self._frame.apply(map.points3D_in_world),
            map.colors,
            point_size=_POINT_SIZE,
            point_shape="circle",
            precision="float32",
        )

    def add_frustum(
        self,
        group: str,
        name: str,
        camera: pycolmap.Camera,
        cam_from_world: pycolmap.Rigid3d,
        color: RGB,
        photo: Image | None = None,
    ) -> viser.CameraFrustumHandle:
        """Show where an image was taken, or move what is shown of it; distortion is left out."""
        K = camera.calibration_matrix()
        half_width, half_height = camera.width / (2 * K[0, 0]), camera.height / (2 * K[1, 1])
        view_from_cam = self._rotation @ cam_from_world.rotation.inverse().matrix()
        return self.server.scene.add_camera_frustum(
            f"{group}/{quote(name, safe='')}",
            fov=float(2 * np.arctan(half_height)),
            aspect=half_width / half_height,
            # viser divides by this root: it scales all frustums to one volume
            scale=self._depth * float(np.cbrt(half_width * half_height / 3)),
            thickness=_LINE_PX,
            thickness_units="screen",
            color=color,
            image=photo,
            wxyz=viser.transforms.SO3.from_matrix(view_from_cam).wxyz,
            position=self._frame.apply(cam_from_world.inverse().translation[None])[0],
        )

    def look_from(self, client: viser.ClientHandle, frustum: viser.CameraFrustumHandle) -> None:
        """Let somebody look from a camera, just before its photo, and turn about what it looks at."""
        axis = viser.transforms.SO3(frustum.wxyz).as_matrix()[:, 2]
        to_object = max(float(-frustum.position @ axis), 2 * self._depth)
        with client.atomic():
            client.camera.position = frustum.position + _BEFORE_PHOTO * self._depth * axis
            client.camera.wxyz = frustum.wxyz
            client.camera.look_at = frustum.position + to_object * axis
