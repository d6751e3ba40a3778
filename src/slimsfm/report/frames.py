"""Query images with the object's box drawn in, and JPEGs embedded in the page."""

import base64
import io
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64
from PIL import Image as PillowImage

from slimsfm.arrays import Image
from slimsfm.errors import InputError
from slimsfm.files import inside
from slimsfm.geometry import BOX_EDGES, Box, project
from slimsfm.photos import read_image, shrink

ESTIMATED_RGB = (235, 45, 40)
"""Color of the box at the estimated pose."""

TRUE_RGB = (30, 200, 70)
"""Color of the box at the true pose."""

_SAMPLES = 33  # points per edge, which distortion bends
_NEAR = 1e-3  # depth at which edges are clipped, relative to the box's diagonal
_SUBPIXEL_BITS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryFrame:
    """A query image with its estimated and true pose."""

    image: Image
    """Upright RGB."""

    camera: pycolmap.Camera
    """Intrinsics of the image."""

    estimated_cam_from_world: pycolmap.Rigid3d | None
    """None if the query was not localized."""

    true_cam_from_world: pycolmap.Rigid3d
    """The true pose."""

    label: str
    """Name of the image."""

    verdict: str
    """Outcome of the query, for the caption."""

    def __post_init__(self) -> None:
        if (self.camera.width, self.camera.height) != self.image.shape[1::-1]:
            raise ValueError(
                f"camera has {self.camera.width}x{self.camera.height} pixels, the image "
                f"{self.image.shape[1]}x{self.image.shape[0]}"
            )


def frame_html(frame: QueryFrame, box: Box, max_size: int) -> str:
    """The frame as an HTML figure with an embedded image."""
    label = escape(frame.label)
    uri = jpeg_uri(draw_frame(frame, box, max_size), thin_lines=True)
    return (
        f'<figure><img src="{uri}" alt="{label} with boxes">'
        f"<figcaption><b>{label}</b> {escape(frame.verdict)}</figcaption></figure>"
    )


def draw_frame(frame: QueryFrame, box: Box, max_size: int) -> Image:
    """The image, at most `max_size` pixels long, with the true box in green and the estimated one in red."""
    height, width = frame.image.shape[:2]
    scale = min(1.0, max_size / max(height, width))
    camera = pycolmap.Camera(frame.camera.todict())
    camera.rescale(max(1, round(width * scale)), max(1, round(height * scale)))
    size = (camera.width, camera.height)
    drawn = np.ascontiguousarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA))
    # the true box is thicker, so that it shows where the two coincide
    draw_box(drawn, box, frame.true_cam_from_world, camera, TRUE_RGB, thickness=4)
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
    """Draw the edges of a box into an image, as a camera with this pose sees them."""
    for i, j in BOX_EDGES:
        edge = cam_from_world * box.corners[[i, j]]
        clipped = _before_camera(edge, _NEAR * box.diagonal)
        if clipped is not None:
            _draw_polyline(image, _bent(clipped, camera), color, thickness)


def _before_camera(edge_in_cam: Float64[np.ndarray, "2 3"], near: float) -> Float64[np.ndarray, "2 3"] | None:
    """The part of an edge in front of the camera, or None."""
    near_end, far_end = edge_in_cam[np.argsort(edge_in_cam[:, 2])]
    if far_end[2] <= near:
        return None
    if near_end[2] < near:
        share = (near - near_end[2]) / (far_end[2] - near_end[2])
        near_end = near_end + share * (far_end - near_end)
    return np.stack([near_end, far_end])


def _bent(edge_in_cam: Float64[np.ndarray, "2 3"], camera: pycolmap.Camera) -> Float64[np.ndarray, "n 2"]:
    """Pixel positions along an edge; NaN where the distortion model is not invertible.

    Far outside the image a distortion polynomial folds back into it. Undistorting such a pixel does not
    return its ray.
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
    """Draw the parts in or near the image; OpenCV does not accept arbitrarily large coordinates."""
    reach = 4 * max(image.shape)
    pixels = points2D - 0.5  # OpenCV puts the center of the top-left pixel at (0, 0)
    usable = np.all(np.abs(np.nan_to_num(pixels, nan=np.inf)) < reach, axis=1)
    whole = np.rint(np.where(usable[:, None], pixels, 0) * 2**_SUBPIXEL_BITS).astype(int)
    for k in np.flatnonzero(usable[:-1] & usable[1:]):
        ends = whole[k].tolist(), whole[k + 1].tolist()
        cv2.line(image, *ends, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def jpeg_uri(image: Image, *, thin_lines: bool) -> str:
    """An image as a data URI.

    Args:
        image: RGB.
        thin_lines: Keep the colors of thin lines, for about 50 % more bytes.
    """
    buffer = io.BytesIO()
    quality, subsampling = (80, "4:4:4") if thin_lines else (75, "4:2:0")
    PillowImage.fromarray(image).save(buffer, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def photo_uri(folder: Path, name: str, max_size: int) -> str | None:
    """A photo as a data URI, its longer side at most `max_size` pixels; None if it cannot be read."""
    try:
        return jpeg_uri(shrink(read_image(inside(folder, name)), max_size), thin_lines=False)
    except InputError:
        return None
