"""A film of an object for tracking: a hand-held camera with fast turns, one occlusion and one cut."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float64

from slimsfm.arrays import Image
from slimsfm.geometry import Box
from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.render import Light, Scene, render, visible_meshes
from slimsfm.synthetic.scene import (
    elsewhere,
    eyes,
    look_at,
    object_box,
    phone_camera,
    textured_object,
    viewing_distance,
    with_noise,
)

FRAMES_PER_SECOND = 30

Series = Float64[np.ndarray, " frames"]

_PAN, _ROLL = 9.0, 26.0  # degrees to either side in fast turns
_PAN_HZ, _ROLL_HZ = 1.2, 1.1
_PANS = ((0.10, 0.26), (0.60, 0.72), (0.90, 0.98))
_ROLLS = ((0.30, 0.44), (0.64, 0.74))
_CUT, _BLOCKED = 0.52, 0.78
"""Times of these events, as shares of the film."""

_LENS = 0.02  # difference to the camera of the mapping take
_SLIDE = 12  # frames in which the plate enters or leaves; it hides the object in half of them
_PLATE_DEPTH, _PLATE_AWAY = 0.10, 0.155  # meters in front of the camera; to its side when out of sight
_BLUR_PX = 2.0  # blur of the plate in an image 640 pixels wide, because it is out of focus
_COARSE = 120  # width in pixels of the images that measure the visible share


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """A scene, a camera path through it, and a plate that is held in front of the camera for a while."""

    scene: Scene
    """The scene in the frame of the object, which is its first mesh."""

    plate: Scene
    """The plate in its own frame; where visible, it is nearer than the scene."""

    camera: pycolmap.Camera

    cam_from_object: tuple[pycolmap.Rigid3d, ...]
    """One pose per frame, at `FRAMES_PER_SECOND`."""

    cam_from_plate: Mapping[int, pycolmap.Rigid3d]
    """Poses by frame index, for frames that may see the plate."""

    visible: Series
    """Per frame, the share of unoccluded pixels of the object; all of them are inside the image."""

    cut: int
    """The first frame after the cut, where the camera jumps."""

    occlusion: range
    """The frames in which the plate hides the object completely."""

    box: Box
    """Box of the object, in its frame."""

    seed: tuple[int, ...]

    def frame(self, index: int) -> Image:
        """Render one frame with sensor noise; equal calls give equal images."""
        image = render(self.scene, self.camera, self.cam_from_object[index])
        if index in self.cam_from_plate:
            image = _blocked(image, self.plate, self.camera, self.cam_from_plate[index])
        return with_noise(image, (*self.seed, index))


def film(
    name: str = "printed_box", frames: int = 600, width: int = 640, height: int = 480, seed: int = 0
) -> Film:
    """Film an object among the clutter of its query take.

    The camera walks around the object at 17 degrees per second. In some passages it pans by up to 68 or rolls
    by up to 180 degrees per second, so that the object moves by about 4 % of the image width from frame to
    frame, but stays in the image. Speeds hardly depend on the length of the film, but the times of events do:
    the cut is near the middle, and a plate hides the object for a twentieth of the film, or for 13 frames if
    that is more.

    Args:
        name: A key of `OBJECTS`.
        frames: Number of frames, at least 200.
        width: Image width in pixels; the field of view stays the same.
        height: Image height in pixels.
        seed: Seed of the prints, the clutter, the camera shake and the noise.

    Raises:
        ValueError: `name` is not in `OBJECTS`, or the film is too short for all its events.
    """
    if frames < 200:
        raise ValueError(f"frames must be at least 200, got {frames}")
    mesh, key = textured_object(name, seed), (seed, sorted(OBJECTS).index(name), 2)
    rng = np.random.default_rng(key)
    scene, plate = elsewhere(rng, mesh), _plate(rng)
    cut, start = round(_CUT * frames), round(_BLOCKED * frames)
    poses = _path(rng, frames, cut, 1.35 * viewing_distance(mesh))
    plates = _plate_path(range(start, start + max(1, round(frames / 20) - _SLIDE)))
    alone = Scene([mesh], Light())
    visible = _visible((scene, alone), plate, _coarse(width, height), poses, plates)
    hidden = [index for index in plates if visible[index] == 0]
    return Film(
        scene=scene,
        plate=plate,
        camera=phone_camera(width, height, _LENS),
        cam_from_object=tuple(poses),
        cam_from_plate=plates,
        visible=visible,
        cut=cut,
        occlusion=range(hidden[0], hidden[-1] + 1),
        box=object_box(mesh),
        seed=key,
    )


def _path(rng: np.random.Generator, frames: int, cut: int, radius: float) -> list[pycolmap.Rigid3d]:
    time, share = np.arange(frames) / FRAMES_PER_SECOND, np.arange(frames) / frames
    after = np.arange(frames) >= cut
    azimuths = 0.6 - 0.3 * time + 2.4 * after + np.radians(_tremor(rng, time, 1.0))
    elevations = np.radians(34 + 9 * np.sin(2 * np.pi * time / 7.3) + 12 * after)
    radii = radius * (1 + 0.12 * np.sin(2 * np.pi * time / 5.1) - 0.08 * after)
    positions = eyes(azimuths, elevations, radii)
    fast = _pass(share, _PANS)
    pans = _PAN * fast * np.sin(2 * np.pi * _PAN_HZ * time) + _tremor(rng, time, 0.8)
    tilts = 3 * fast * np.sin(2 * np.pi * 0.8 * time) + _tremor(rng, time, 0.8)
    rolls = _ROLL * _pass(share, _ROLLS) * np.sin(2 * np.pi * _ROLL_HZ * time) + _tremor(rng, time, 1.0)
    turns = np.radians(np.stack([tilts, pans, np.zeros(frames)], axis=1))
    return [
        _turned(turn) * look_at(eye, np.zeros(3), float(roll))
        for eye, turn, roll in zip(positions, turns, rolls, strict=True)
    ]


def _turned(axis_angle: Float64[np.ndarray, "3"]) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(axis_angle), np.zeros(3))


def _pass(share: Series, passages: tuple[tuple[float, float], ...]) -> Series:
    """1 in the passages, 0 elsewhere, with smooth transitions."""
    total = np.zeros_like(share)
    for start, stop in passages:
        edge = 0.25 * (stop - start)
        total += _smooth((share - start) / edge) * _smooth((stop - share) / edge)
    return total


def _smooth(value: Series) -> Series:
    x = np.clip(value, 0, 1)
    return x * x * (3 - 2 * x)


def _tremor(rng: np.random.Generator, time: Series, amplitude_deg: float) -> Series:
    """Shake of a hand: three waves, slower ones with larger amplitudes."""
    waves = zip((0.4, 1.3, 3.7), (1.0, 0.3, 0.08), rng.uniform(0, 2 * np.pi, 3), strict=True)
    return sum(
        (amplitude_deg * size * np.sin(2 * np.pi * hz * time + phase) for hz, size, phase in waves),
        start=np.zeros_like(time),
    )


def _plate(rng: np.random.Generator) -> Scene:
    """A printed card, facing the camera and upside down."""
    images = [texture.page(rng, 700, 900, cell=110) for _ in range(6)]
    card = shapes.box((0.18, 0.002, 0.14), images)
    card.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return Scene([card], Light(towards=(0.3, -0.4, -1.0), lamp=(0.5, 0.48, 0.44), ambient=(0.4, 0.4, 0.42)))


def _plate_path(held: range) -> dict[int, pycolmap.Rigid3d]:
    """In from the right, held with a slow drift, and out to the left."""
    poses = {}
    for index in range(held.start - _SLIDE, held.stop + _SLIDE):
        before, past = held.start - index, index - (held.stop - 1)
        way = _smooth(np.array([before, past]) / (_SLIDE + 1)) @ (1.0, -1.0)
        drift = 0.004 * np.sin(0.3 * (index - held.start))
        place = np.array([_PLATE_AWAY * way + drift, drift, _PLATE_DEPTH])
        poses[index] = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 0.1 + 8 * drift])), place)
    return poses


def _blocked(image: Image, plate: Scene, camera: pycolmap.Camera, cam_from_plate: pycolmap.Rigid3d) -> Image:
    """Draw the plate over an image, out of focus."""
    covered = (visible_meshes(plate, camera, cam_from_plate) >= 0).astype(np.float32)[..., None]
    sigma = _BLUR_PX * camera.width / 640
    layers = np.concatenate([render(plate, camera, cam_from_plate) * covered, covered], axis=2)
    blurred = cv2.GaussianBlur(layers, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    over = blurred[..., :3] + (1 - blurred[..., 3:]) * image
    return np.clip(np.rint(over), 0, 255).astype(np.uint8)


def _coarse(width: int, height: int) -> pycolmap.Camera:
    return phone_camera(_COARSE, round(_COARSE * height / width), _LENS)


def _visible(
    scenes: tuple[Scene, Scene],
    plate: Scene,
    camera: pycolmap.Camera,
    poses: list[pycolmap.Rigid3d],
    plates: Mapping[int, pycolmap.Rigid3d],
) -> Series:
    """Visible pixels of the object in the first scene, behind the plate, over those in the second."""
    shares = []
    for index, pose in enumerate(poses):
        seen, whole = (visible_meshes(scene, camera, pose) == 0 for scene in scenes)
        seen &= whole  # they may differ by a pixel at a rim
        if index in plates:
            seen &= visible_meshes(plate, camera, plates[index]) < 0
        shares.append(seen.sum() / whole.sum())
    return np.array(shares)
