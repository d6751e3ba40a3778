"""Which direction of a map is up: from how its photos were held, or from measured gravity."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points3D
from slimsfm.errors import InputError
from slimsfm.files import contents_of, plain, read_json
from slimsfm.mapping.map import Map
from slimsfm.upkeep.similarity import MAX_TURN_DEG

Direction = Float64[np.ndarray, "3"]

_LEVEL_DEG = 1.0  # at least so exactly are cameras held level, as a standard deviation
_ROUNDS = 50
_AGREE = 0.8  # of the cameras, on which side is up


@dataclass(frozen=True, kw_only=True, eq=False)
class Up:
    """The direction up, and what it rests on."""

    direction: Direction
    """Unit vector in the frame of the map."""

    deviations_deg: Float64[np.ndarray, " n"]
    """How far each camera deviates from it: the slope of its x axis, or the angle to its measured gravity."""

    bound_deg: float
    """Error that 95 % of such estimates stay below."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Down:
    """Gravity as it was measured: in the frame of the map, or in the cameras of some images."""

    in_world: Direction | None = None
    """Direction down in the frame of the map."""

    in_cam: Mapping[str, Direction] | None = None
    """Direction down by image name, in the frame of its camera: x right, y down, z forward."""


def read_down(path: str | Path) -> Down:
    """Read measured gravity from JSON: `{"world": [x, y, z]}` or `{"images": {NAME: [x, y, z]}}`.

    A file as `localize` takes it, with both, is read for its images. In ARKit's world, down is (0, -1, 0).

    Raises:
        InputError: The file is missing or has other contents.
    """
    path = Path(path)
    with contents_of(path, 'should hold {"world": [x, y, z]} or {"images": {NAME: [x, y, z], ...}}'):
        data = read_json(path)
        if images := data.get("images"):
            return Down(in_cam={name: _unit(plain(one, list[float])) for name, one in images.items()})
        return Down(in_world=_unit(plain(data["world"], list[float])))


def up_of(map: Map, down: Down | None) -> Up:
    """The direction up by measured gravity, or else by the cameras.

    Raises:
        InputError: The map has no image that gravity is known of, or up is not determined.
    """
    if down is None:
        return up_of_cameras(map)
    if down.in_world is not None:
        return Up(direction=-down.in_world, deviations_deg=np.zeros(0), bound_deg=0.0)
    measured = {name: one for name, one in (down.in_cam or {}).items() if name in map.images}
    if not measured:
        raise InputError("none of the images whose gravity is given is in the map; give names of its images")
    ups = -np.array([_in_world(map.images[name].cam_from_world(), one) for name, one in measured.items()])
    middle = _geometric_median(ups)
    deviations = np.degrees(np.arccos(np.clip(ups @ middle, -1, 1)))
    bound = 2 * max(float(np.median(deviations)), _LEVEL_DEG) / np.sqrt(len(ups))
    if np.median(deviations) > MAX_TURN_DEG:
        raise InputError(
            "the given directions of gravity contradict the images: they differ by "
            f"{np.median(deviations):.0f}° (median) in the map; check that they are in the frames of the "
            "cameras (x right, y down, z forward)"
        )
    return Up(direction=middle, deviations_deg=deviations, bound_deg=bound)


def up_of_cameras(map: Map) -> Up:
    """The direction that the x axes of the cameras are perpendicular to, because photos are held level.

    Least absolute deviations, so that some tilted photos do not matter.

    Raises:
        InputError: All cameras look in about the same direction, are tilted, or disagree on what is up.
    """
    turns = np.array([image.cam_from_world().rotation.matrix() for image in map.images.values()])
    level, above = turns[:, 0], -turns[:, 1]
    direction = _normal(level)
    direction *= np.sign(np.sum(np.sign(above @ direction))) or 1
    slopes = np.degrees(np.arcsin(np.clip(np.abs(level @ direction), 0, 1)))
    sigma = max(1.4826 * float(np.median(slopes)), _LEVEL_DEG)
    across = np.linalg.eigvalsh(level.T @ level)[1]  # how much of the x axes lies beside their main direction
    bound = 2 * sigma / max(np.sqrt(across), 1e-9)
    if len(turns) < 3 or bound > MAX_TURN_DEG:
        raise InputError(
            f"the {len(turns)} cameras do not determine what is up: they look in almost one direction or are "
            f"tilted, so it may be {min(bound, 180):.0f}° off; give `down` as measured by the device"
        )
    if np.mean(above @ direction > 0) < _AGREE:
        raise InputError(
            "the cameras do not agree on what is up: some are upside down, or they look straight down; give "
            "`down` as measured by the device"
        )
    return Up(direction=direction, deviations_deg=slopes, bound_deg=float(bound))


def level_from_world(up: Direction) -> pycolmap.Sim3d:
    """The smallest rotation that makes a direction the z axis."""
    axis, cosine = np.cross(up, [0, 0, 1]), float(up[2])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        axis, sine = np.array([1.0, 0, 0]), 1.0
        angle = 0.0 if cosine > 0 else np.pi
    else:
        angle = float(np.arctan2(sine, cosine))
    return pycolmap.Sim3d(1.0, pycolmap.Rotation3d(axis / sine * angle), np.zeros(3))


def _normal(rows: Points3D) -> Direction:
    """The direction with the smallest sum of absolute products with rows, by reweighting."""
    weights, direction = np.ones(len(rows)), np.zeros(3)
    for _ in range(_ROUNDS):
        direction = np.linalg.eigh((rows * weights[:, None]).T @ rows)[1][:, 0]
        weights = 1 / np.maximum(np.abs(rows @ direction), np.radians(_LEVEL_DEG))
    return direction


def _geometric_median(directions: Points3D) -> Direction:
    weights, middle = np.ones(len(directions)), directions[0]
    for _ in range(_ROUNDS):
        middle = _unit(weights @ directions)
        weights = 1 / np.maximum(np.linalg.norm(directions - middle, axis=1), np.radians(_LEVEL_DEG))
    return middle


def _in_world(cam_from_world: pycolmap.Rigid3d, direction: Direction) -> Direction:
    return cam_from_world.rotation.inverse() * direction


def _unit(values: list[float] | Direction) -> Direction:
    vector = np.array(values, np.float64).reshape(3)
    length = np.linalg.norm(vector)
    if not np.isfinite(length) or length == 0:
        raise ValueError("a direction must be finite and not zero")
    return vector / length
