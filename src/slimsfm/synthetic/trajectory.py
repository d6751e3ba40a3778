"""Camera paths around an object with its center at the origin, z up."""

import numpy as np
import pycolmap
from jaxtyping import Float64

Vector = Float64[np.ndarray, "3"]


def look_at(eye: Vector, target: Vector, roll_deg: float = 0.0) -> pycolmap.Rigid3d:
    """Pose of a camera at `eye` that looks at `target`, upright except for a roll about its axis.

    Args:
        eye: Position of the camera in the world.
        target: Point to look at; not straight above or below the camera.
        roll_deg: Positive values turn the image counterclockwise.

    Raises:
        ValueError: The view is vertical, so upright is not defined.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"eye {eye.tolist()} must not be straight above or below target {target.tolist()}")
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward])
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    rolled = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ upright
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rolled), -rolled @ eye)


def mapping_path(frames: int, radius: float) -> list[pycolmap.Rigid3d]:
    """A spiral from 10 to 70 degrees above the horizon, with evenly spaced neighbors.

    Args:
        frames: Number of poses.
        radius: Distance to the center of the object, in meters; it varies by 8 %.
    """
    share = (np.arange(frames) + 0.5) / frames
    azimuths = 2 * np.pi * share * np.sqrt(frames / 8)
    places = eyes(azimuths, np.radians(10 + 60 * share), radius * (1 + 0.08 * np.sin(7 * share)))
    return [look_at(eye, np.zeros(3)) for eye in places]


def query_path(rng: np.random.Generator, frames: int, radius: float) -> list[pycolmap.Rigid3d]:
    """A different path: once around in the other direction, between 18 and 58 degrees above the horizon.

    The camera misses the center by up to 8 % of the radius, and rolls by up to 15 degrees.

    Args:
        rng: Random number generator for the camera shake.
        frames: Number of poses.
        radius: Mean distance to the center of the object, in meters; it varies by 22 %.
    """
    share = (np.arange(frames) + 0.5) / frames
    elevations = np.radians(38 + 20 * np.sin(2 * np.pi * (2.3 * share + 0.15)))
    radii = radius * (1 + 0.22 * np.sin(2 * np.pi * (1.7 * share + 0.4)))
    places = eyes(0.6 - 2 * np.pi * share, elevations, radii)
    targets = rng.uniform(-0.08, 0.08, (frames, 3)) * radius
    rolls = 15 * np.sin(2 * np.pi * 3 * share) * rng.uniform(0.5, 1, frames)
    return [
        look_at(eye, target, float(roll)) for eye, target, roll in zip(places, targets, rolls, strict=True)
    ]


def eyes(
    azimuths: Float64[np.ndarray, " n"],
    elevations: Float64[np.ndarray, " n"],
    radii: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Positions at these azimuths and elevations, in radians, and distances from the origin."""
    level = np.cos(elevations)
    unit = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)], axis=1)
    return radii[:, None] * unit
