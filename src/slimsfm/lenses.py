"""Whether a camera may exist: what is wrong with intrinsics that no lens and no photo has."""

import math
from functools import lru_cache

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from slimsfm.arrays import Points2D

_MOST_PIXELS = 1_000_000  # along a side
_FOCAL = 0.05, 1000.0  # over the longer side: from the widest fisheye to a crop of a telescope's image
_MOST_ASPECT = 10.0  # ratio of the focal lengths: photos squeezed into another shape reach 3
_MOST_OFF_AXIS = 3.0  # focal lengths from the principal point to the nearest pixel: 70 degrees off the axis
_CELLS = 12  # along each side, in which distortion is checked
_ROUND_TRIP = 0.002  # of the longer side, from a pixel to its ray and back
_STRETCHED = 3.0  # pixels per undistorted pixel in the direction in which they are most
_SQUEEZED = 25.0  # area on the sphere of rays, over the area of its pixels
_LEAST_SOUND = 1 / 3  # of the cells: calibrations are often wrong where no keypoints were
_LEAST_OF_CIRCLE = 0.05  # of the cells, around a fisheye's image circle
_NARROW, _WIDE, _WIDEST = (math.tan(math.radians(angle)) for angle in (45, 60, 89.5))  # of its rays


def camera_fault(camera: pycolmap.Camera) -> str | None:
    """What makes intrinsics impossible, or None if a camera may have them.

    The limits are generous: fisheye lenses, telescopes, crops far from the center, squeezed photos and
    calibrations that are wrong in the corners are possible. Distortion is impossible where several rays meet
    in a pixel, where a pixel has no ray, and where it stretches or squeezes more than any lens. A camera is
    impossible if that is so in two thirds of its image; around the image circle of a fisheye it may be so.

    Args:
        camera: A camera of any COLMAP model.

    Returns:
        A phrase that says what is impossible, in which "it" is the camera.
    """
    return _fault(camera.model, camera.width, camera.height, tuple(camera.params))


@lru_cache(maxsize=1024)  # images of a video share their camera
def _fault(model: pycolmap.CameraModelId, width: int, height: int, params: tuple[float, ...]) -> str | None:
    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    longer_px = max(width, height)
    if min(width, height) < 1 or longer_px > _MOST_PIXELS:
        return f"its size of {width}x{height} pixels is impossible"
    if camera.is_spherical():
        return f"it is spherical ({camera.model_name}), which is not supported"
    if not camera.verify_params():
        return f"{camera.model_name} has the parameters {camera.params_info}, not {camera.params_to_string()}"
    if not np.isfinite(camera.params).all():
        return f"its parameters {camera.params_to_string()} are not finite"
    return _pinhole_fault(camera, longer_px) or _distortion_fault(camera, longer_px)


def _pinhole_fault(camera: pycolmap.Camera, longer_px: int) -> str | None:
    focal_px = camera.params[camera.focal_length_idxs()]
    low, high = (limit * longer_px for limit in _FOCAL)
    if not (low <= focal_px.min() and focal_px.max() <= high):
        return (
            f"its focal length of {' and '.join(f'{one:g}' for one in focal_px)} pixels is impossible for an "
            f"image of {camera.width}x{camera.height}: it must be between {low:g} and {high:g}"
        )
    if focal_px.max() > _MOST_ASPECT * focal_px.min():
        return f"its focal lengths {focal_px[0]:g} and {focal_px[1]:g} differ too much"
    center = camera.params[camera.principal_point_idxs()]
    outside = np.maximum(np.maximum(-center, center - (camera.width, camera.height)), 0) / focal_px
    if outside.max() > _MOST_OFF_AXIS:
        return (
            f"its principal point ({center[0]:g}, {center[1]:g}) is too far outside an image of "
            f"{camera.width}x{camera.height}"
        )
    return None


def _distortion_fault(camera: pycolmap.Camera, longer_px: int) -> str | None:
    if not len(camera.extra_params_idxs()):
        return None
    sides = [np.linspace(0, side, _CELLS + 1) for side in (camera.width, camera.height)]
    pixels = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    with np.errstate(all="ignore"):
        rays = _rays(camera, pixels.reshape(-1, 2), _ROUND_TRIP * longer_px).reshape(pixels.shape)
        sound = _is_sound(camera, rays)
        off_axis = np.linalg.norm(rays, axis=-1)[:-1, :-1][sound]
    is_circle = off_axis.min(initial=np.inf) < _NARROW and off_axis.max(initial=0) > _WIDE
    if sound.mean() > (_LEAST_OF_CIRCLE if is_circle else _LEAST_SOUND):
        return None
    return (
        f"its distortion ({camera.params_to_string()}) folds, stretches or squeezes most of an image of "
        f"{camera.width}x{camera.height} as no lens does"
    )


def _rays(camera: pycolmap.Camera, pixels: Points2D, most_px: float) -> Points2D:
    """Where the rays of pixels meet the plane at depth 1; NaN where none leads back to its pixel."""
    rays = np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)
    back = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2)
    errors, off_axis = (np.linalg.norm(one, axis=1, keepdims=True) for one in (back - pixels, rays))
    return np.where((errors < most_px) & (off_axis < _WIDEST), rays, np.nan)


def _is_sound(
    camera: pycolmap.Camera, rays: Float64[np.ndarray, "columns rows 2"]
) -> Bool[np.ndarray, "columns-1 rows-1"]:
    """Whether distortion is possible in each cell between neighboring rays of a grid on the image."""
    focal_px = camera.params[camera.focal_length_idxs()]
    corners = rays[:-1, :-1], rays[1:, :-1], rays[:-1, 1:], rays[1:, 1:]
    along_x = (corners[1] + corners[3] - corners[0] - corners[2]) * (focal_px[0] * _CELLS / camera.width / 2)
    along_y = (corners[2] + corners[3] - corners[0] - corners[1]) * (
        focal_px[-1] * _CELLS / camera.height / 2
    )
    # of undistorted pixels over that of pixels; on the sphere, distances shrink with the angle to the axis
    area = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    squares = np.sum(along_x**2 + along_y**2, axis=-1)
    smallest = squares / 2 - np.sqrt(np.maximum(squares**2 / 4 - area**2, 0))
    on_sphere = area / (1 + np.sum(np.mean(corners, axis=0) ** 2, axis=-1)) ** 1.5
    return (area > 0) & (smallest > _STRETCHED**-2) & (on_sphere < _SQUEEZED)
