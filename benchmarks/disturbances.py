"""What happens to photos before they are localized: zoomed, cropped, framed, mirrored, blurred, dark, hidden.

Each disturbance is a pure function. It takes a photo with its true camera and pose and gives the changed
photo, the true camera of that, and what its user believes the camera to be: one that is given, what EXIF
says, or nothing. Poses stay what they were, except that a mirrored photo has none that is right.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import Image
from slimsfm.geometry import Box, project
from slimsfm.pose.priors import with_focal_length
from slimsfm.synthetic import texture

_FILM_DIAGONAL_MM = float(np.hypot(36, 24))
_PHOTONS, _READ_NOISE, _NIGHT = (
    20.0,
    2.0,
    0.15,
)  # electrons of a white pixel and of noise, and how bright white looks


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A photo with what is true of it."""

    image: Image
    """RGB."""

    camera: pycolmap.Camera
    """The true intrinsics of its pixels."""

    cam_from_world: pycolmap.Rigid3d | None
    """The true pose; None if no pose is right."""


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What is done to the pixels of a photo, and what is believed of its camera."""

    group: str
    """Class of the disturbance, over which reliability is measured."""

    pixels: str = "clean"
    """Name of the change of the pixels, a key of `CHANGES`; "file" leaves the file as it is."""

    given: float | None = None
    """The camera that is given has this many times the true focal length; None: none is given."""

    exif: float | None = None
    """EXIF says this many times the true focal length; None: there is no EXIF."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where in a photo to change something."""

    box: Box
    """Box of the object, in the frame of the poses."""

    rng: np.random.Generator
    """What decides where there is a choice."""


Change = Callable[[View, Place], View]


def cropped(view: View, left: int, top: int, width: int, height: int) -> View:
    """The part of a photo that starts at this pixel; negative values and larger sizes add a white frame."""
    rows, columns = view.image.shape[:2]
    below, right = max(0, top + height - rows), max(0, left + width - columns)
    pads = (max(0, -top), below), (max(0, -left), right), (0, 0)
    padded = np.pad(view.image, pads, constant_values=255)
    row, column = max(0, top), max(0, left)
    camera = pycolmap.Camera(view.camera.todict())
    params = camera.params.copy()
    params[camera.principal_point_idxs()] -= (left, top)
    camera.params, camera.width, camera.height = params.tolist(), width, height
    return replace(view, image=padded[row : row + height, column : column + width], camera=camera)


def resized(view: View, width: int, height: int) -> View:
    """The photo with another number of pixels, which are not square if the aspect ratio changes."""
    scale_x, scale_y = width / view.camera.width, height / view.camera.height
    square = abs(scale_x / scale_y - 1) < 0.01
    method = cv2.INTER_AREA if scale_x * scale_y < 1 else cv2.INTER_CUBIC
    image = np.asarray(cv2.resize(view.image, (width, height), interpolation=method), np.uint8)
    camera = pycolmap.Camera(view.camera.todict()) if square else with_two_focal_lengths(view.camera)
    params, focal, center = camera.params.copy(), camera.focal_length_idxs(), camera.principal_point_idxs()
    params[focal] *= (scale_x, scale_y) if len(focal) == 2 else np.sqrt(scale_x * scale_y)
    params[center] *= (scale_x, scale_y)
    camera.params, camera.width, camera.height = params.tolist(), width, height
    return replace(view, image=image, camera=camera)


def with_two_focal_lengths(camera: pycolmap.Camera) -> pycolmap.Camera:
    """An equal camera with a focal length for each axis.

    Raises:
        ValueError: The camera model is not one of those that maps of these scenes have.
    """
    if len(camera.focal_length_idxs()) == 2:
        return pycolmap.Camera(camera.todict())
    if camera.model_name not in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise ValueError(f"camera must be SIMPLE_PINHOLE, SIMPLE_RADIAL or RADIAL, got {camera.model_name}")
    focal, x, y, *radial = camera.params.tolist()
    params = [focal, focal, x, y, *radial, *[0.0] * (4 - len(radial))]
    return pycolmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=params)


def zoomed(view: View, factor: float) -> View:
    """Digital zoom: the middle of the photo, enlarged to all its pixels; below 1 a white frame around it."""
    return _window(view, 1 / factor, (0.5, 0.5), enlarge=True)


def center_crop(view: View, _: Place) -> View:
    """The middle of the photo, 70 % of each side."""
    return _window(view, 0.7, (0.5, 0.5))


def corner_crop(view: View, place: Place) -> View:
    """A corner of the photo, 70 % of each side."""
    x, y = place.rng.integers(0, 2, 2).tolist()
    return _window(view, 0.7, (x, y))


def stabilized(view: View, place: Place) -> View:
    """90 % of each side, from where the stabilizer of a film puts it, enlarged to all pixels."""
    x, y = place.rng.uniform(0, 1, 2).tolist()
    return _window(view, 0.9, (x, y), enlarge=True)


def squeezed(view: View, _: Place) -> View:
    """The width shrunk to 75 %, so that pixels are not square."""
    return resized(view, round(0.75 * view.camera.width), view.camera.height)


def mirrored(view: View, _: Place) -> View:
    """Left and right exchanged, as selfie cameras do."""
    camera = pycolmap.Camera(view.camera.todict())
    params, center = camera.params.copy(), camera.principal_point_idxs()[0]
    params[center] = camera.width - params[center]
    camera.params = params.tolist()
    return View(image=np.ascontiguousarray(view.image[:, ::-1]), camera=camera, cam_from_world=None)


def blurred(view: View, sigma_px: float) -> View:
    """Out of focus."""
    return replace(view, image=np.asarray(cv2.GaussianBlur(view.image, (0, 0), sigma_px), np.uint8))


def dark(view: View, place: Place) -> View:
    """At night: few photons, the noise of the sensor, and a dim picture."""
    electrons = place.rng.poisson(_PHOTONS * (view.image / 255.0) ** 2.2)
    noisy = electrons + _READ_NOISE * place.rng.standard_normal(view.image.shape)
    dim = np.clip(_NIGHT * noisy / _PHOTONS, 0, 1) ** (1 / 2.2)
    return replace(view, image=np.rint(255 * dim).astype(np.uint8))


def hidden(view: View, place: Place, share: float) -> View:
    """Something printed in front of the object, from one side of where its box is."""
    left, top, right, bottom = object_window(view, place.box)
    side = int(place.rng.integers(4))
    if side < 2:
        width = round(share * (right - left))
        left, right = (left, left + width) if side else (right - width, right)
    else:
        height = round(share * (bottom - top))
        top, bottom = (top, top + height) if side == 2 else (bottom - height, bottom)
    image = view.image.copy()
    image[top:bottom, left:right] = texture.page(place.rng, bottom - top, right - left, cell=120)
    return replace(view, image=image)


def object_window(view: View, box: Box) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the box in the photo; of all of the photo if the box is not in it."""
    width, height = view.camera.width, view.camera.height
    whole = (0, 0, width, height)
    corners = box.corners
    if view.cam_from_world is None or np.any((view.cam_from_world * corners)[:, 2] <= 0):
        return whole
    pixels = project(corners, view.cam_from_world, view.camera)
    if not np.all(np.isfinite(pixels)):
        return whole
    low, high = np.clip([pixels.min(axis=0), pixels.max(axis=0)], 0, (width, height)).round().astype(int)
    return (*low.tolist(), *high.tolist()) if np.all(high - low > 50) else whole


def _window(view: View, share: float, where: tuple[float, float], *, enlarge: bool = False) -> View:
    """A part with this share of each side; `where` is 0 at the left or top and 1 at the right or bottom."""
    width, height = view.camera.width, view.camera.height
    sides = round(share * width), round(share * height)
    left, top = round(where[0] * (width - sides[0])), round(where[1] * (height - sides[1]))
    part = cropped(view, left, top, *sides)
    return resized(part, width, height) if enlarge else part


CHANGES: dict[str, Change] = {
    "clean": lambda view, _: view,
    "zoom1.3": lambda view, _: zoomed(view, 1.3),
    "zoom2": lambda view, _: zoomed(view, 2.0),
    "frame": lambda view, _: zoomed(view, 1 / 1.3),
    "crop70": center_crop,
    "corner": corner_crop,
    "stabilizer": stabilized,
    "squeezed": squeezed,
    "mirrored": mirrored,
    "blur1.5": lambda view, _: blurred(view, 1.5),
    "blur3": lambda view, _: blurred(view, 3.0),
    "dark": dark,
    "hidden40": lambda view, place: hidden(view, place, 0.4),
    "hidden60": lambda view, place: hidden(view, place, 0.6),
}
"""Changes of the pixels, by name."""

ABSURD = np.inf
"""Stands for the EXIF focal length of 65535 mm that some software writes."""

DISTURBANCES: dict[str, Disturbance] = {
    "clean": Disturbance(group="clean", given=1.0),
    "own": Disturbance(group="own", pixels="file"),
    "focal10": Disturbance(group="focal", given=1.1),
    "focal-10": Disturbance(group="focal", given=0.9),
    "focal30": Disturbance(group="focal", given=1.3),
    "zoom1.3": Disturbance(group="zoom", pixels="zoom1.3"),
    "zoom2": Disturbance(group="zoom", pixels="zoom2"),
    "crop70": Disturbance(group="crop", pixels="crop70"),
    "corner": Disturbance(group="crop", pixels="corner"),
    "stabilizer": Disturbance(group="crop", pixels="stabilizer"),
    "frame": Disturbance(group="frame", pixels="frame"),
    "exif-right": Disturbance(group="exif", exif=1.0),
    "exif-wrong": Disturbance(group="exif", exif=24 / 29),
    "exif-absurd": Disturbance(group="exif", exif=ABSURD),
    "squeezed": Disturbance(group="squeezed", pixels="squeezed"),
    "mirrored": Disturbance(group="mirrored", pixels="mirrored", given=1.0),
    "blur1.5": Disturbance(group="blur", pixels="blur1.5", given=1.0),
    "blur3": Disturbance(group="blur", pixels="blur3", given=1.0),
    "dark": Disturbance(group="dark", pixels="dark", given=1.0),
    "hidden40": Disturbance(group="hidden", pixels="hidden40", given=1.0),
    "hidden60": Disturbance(group="hidden", pixels="hidden60", given=1.0),
}
"""Disturbances of a photo of the scene, by name; photos of other scenes come besides."""


def given_camera(disturbance: Disturbance, true: pycolmap.Camera) -> pycolmap.Camera | None:
    """The camera that the user gives, or None."""
    if disturbance.given is None:
        return None
    return with_focal_length(true, disturbance.given * true.mean_focal_length())


def film_focal_mm(disturbance: Disturbance, true: pycolmap.Camera) -> int | None:
    """EXIF's focal length in 35 mm film, a whole number, or None."""
    if disturbance.exif is None:
        return None
    if disturbance.exif == ABSURD:
        return 65535
    film = _FILM_DIAGONAL_MM * true.mean_focal_length() / float(np.hypot(true.width, true.height))
    return round(disturbance.exif * film)
