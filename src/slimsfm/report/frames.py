"""Query images with the object's box drawn in, estimated and true."""

from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Image
from slimsfm.geometry import BOX_EDGES, Box, project
from slimsfm.report.jpegs import jpeg_uri

ESTIMATED_RGB = (235, 45, 40)
"""Colour of the box under the estimated pose."""

TRUE_RGB = (30, 200, 70)
"""Colour of the box under the true pose."""

_SAMPLES = 33  # points an edge is drawn through: distortion bends it
_NEAR = 1e-3  # depth, over the box's diagonal, at which edges are cut
_SUBPIXEL_BITS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryFrame:
    """A query image and where its camera was thought to stand."""

    image: Image
    """Upright RGB."""

    camera: pycolmap.Camera
    """Intrinsics of the image."""

    estimated_cam_from_world: pycolmap.Rigid3d | None
    """None where the query could not be localized."""

    true_cam_from_world: pycolmap.Rigid3d
    """Where it truly stood."""

    label: str
    """Name of the frame."""

    verdict: str
    """What became of it."""

    def __post_init__(self) -> None:
        if (self.camera.width, self.camera.height) != self.image.shape[1::-1]:
            raise ValueError(
                f"camera is of {self.camera.width}x{self.camera.height} pixels, the image of "
                f"{self.image.shape[1]}x{self.image.shape[0]}"
            )


def frame_html(frame: QueryFrame, box: Box, max_size: int) -> str:
    """The frame as a figure whose image is part of the page."""
    label = escape(frame.label)
    uri = jpeg_uri(draw_frame(frame, box, max_size), thin_lines=True)
    return (
        f'<figure><img src="{uri}" alt="{label} with boxes">'
        f"<figcaption><b>{label}</b> {escape(frame.verdict)}</figcaption></figure>"
    )


def draw_frame(frame: QueryFrame, box: Box, max_size: int) -> Image:
    """The image, at most so many pixels long, with the true box in green and the estimated in red."""
    height, width = frame.image.shape[:2]
    scale = min(1.0, max_size / max(height, width))
    camera = pycolmap.Camera(frame.camera.todict())
    camera.rescale(max(1, round(width * scale)), max(1, round(height * scale)))
    size = (camera.width, camera.height)
    drawn = np.ascontiguousarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA))
    # the true box is the thicker, so that it shows where the two coincide
    draw_box(drawn, box, frame.true_cam_from_world, camera, TRUE_RGB, thickness=5)
    if frame.estimated_cam_from_world is not None:
        draw_box(drawn, box, frame.estimated_cam_from_world, camera, ESTIMATED_RGB, thickness=2)
    return drawn


def draw_box(
    image: Image,
    box: Box,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    color: tuple[int, int, int],
    *,
    thickness: int,
) -> None:
    """Draw the edges of a box into an image, as a camera sees them under a pose."""
    for i, j in BOX_EDGES:
        edge = cam_from_world * box.corners[[i, j]]
        clipped = _before_camera(edge, _NEAR * box.diagonal)
        if clipped is not None:
            _draw_polyline(image, _bent(clipped, camera), color, thickness)


def _before_camera(edge_in_cam: Float64[np.ndarray, "2 3"], near: float) -> Float64[np.ndarray, "2 3"] | None:
    """The part of an edge that lies before the camera, or None."""
    near_end, far_end = edge_in_cam[np.argsort(edge_in_cam[:, 2])]
    if far_end[2] <= near:
        return None
    if near_end[2] < near:
        share = (near - near_end[2]) / (far_end[2] - near_end[2])
        near_end = near_end + share * (far_end - near_end)
    return np.stack([near_end, far_end])


def _bent(edge_in_cam: Float64[np.ndarray, "2 3"], camera: pycolmap.Camera) -> Float64[np.ndarray, "n 2"]:
    """Where an edge runs in the image, in pixels; NaN where the camera's distortion does not reach.

    Far outside the image a distortion polynomial turns back and would put points into it: those do not come
    back to their ray when the distortion is undone.
    """
    shares = np.linspace(0, 1, _SAMPLES)[:, None]
    points = edge_in_cam[0] + shares * (edge_in_cam[1] - edge_in_cam[0])
    points2D = project(points, pycolmap.Rigid3d(), camera)
    rays = points[:, :2] / points[:, 2:]
    back = np.asarray(camera.cam_from_img(points2D), dtype=np.float64).reshape(-1, 2)
    gaps = np.linalg.norm(back - rays, axis=1)
    known = gaps < 1e-3 * (1 + np.linalg.norm(rays, axis=1))
    return np.where(known[:, None], points2D, np.nan)


def _draw_polyline(image: Image, points2D: Float64[np.ndarray, "n 2"], color: tuple, thickness: int) -> None:
    """Draw what lies in or near the image; OpenCV takes no coordinates of any size."""
    reach = 4 * max(image.shape)
    pixels = points2D - 0.5  # OpenCV has the top-left pixel's centre at (0, 0)
    usable = np.all(np.abs(np.nan_to_num(pixels, nan=np.inf)) < reach, axis=1)
    whole = np.rint(np.where(usable[:, None], pixels, 0) * 2**_SUBPIXEL_BITS).astype(int)
    for k in np.flatnonzero(usable[:-1] & usable[1:]):
        ends = whole[k].tolist(), whole[k + 1].tolist()
        cv2.line(image, *ends, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
