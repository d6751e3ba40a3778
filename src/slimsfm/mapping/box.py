"""Read the object's box from a file, or estimate it from the points that the images look at."""

import json
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Ids, Points3D
from slimsfm.errors import InputError
from slimsfm.geometry import Box

_ROUNDS = 50  # of trimming; it converges in fewer
_REACH = 2.0  # points beyond this many times the root mean square distance are background
_SPREAD = 0.25  # of the Gaussian, over the shorter side of the image
_TAIL = 0.01  # share of the weight outside either end of the box


def read_box(path: str | Path) -> Box:
    """Read a box from JSON (`{"corners": [[x, y, z], ...]}` or the list alone) or `box3d_corners.txt`.

    Raises:
        InputError: The file is missing, or does not hold the 8 corners of a box.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".json":
            data = json.loads(path.read_text())
            corners = np.array(data["corners"] if isinstance(data, dict) else data, np.float64)
        else:
            lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
            corners = np.array(lines, np.float64)
        return Box.from_corners(corners)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such box file") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: must hold the 8 corners of a box, each a line or list of x y z ({error})"
        ) from error


def estimate_box(model: pycolmap.Reconstruction) -> Box:
    """Estimate the box of the object that the images look at.

    The weight of a point grows with the number of its observations and with how close they are to the image
    centers. Points farther from the weighted mean than twice the root mean square distance are background;
    they are removed until nothing changes. The box is aligned with the principal axes of the remaining points
    and leaves out 1 % of their weight at each of its sides.

    With masks, all features and points lie on the object, and the same rule works.
    """
    ids = sorted(model.point3D_ids())
    points = np.array([model.point3D(i).xyz for i in ids], np.float64).reshape(-1, 3)
    weights = _centrality(model, np.array(ids, np.int64))
    inside = np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        mean = np.average(points[inside], axis=0, weights=weights[inside])
        squared = ((points - mean) ** 2).sum(axis=1)
        kept = squared <= _REACH**2 * np.average(squared[inside], weights=weights[inside])
        if np.array_equal(kept, inside):
            break
        inside = kept
    return _box_around(points[inside], weights[inside])


def _centrality(model: pycolmap.Reconstruction, ids: Ids) -> Float64[np.ndarray, " n"]:
    """Weight per point: a Gaussian of the distance to the image center, summed over its observations."""
    weights = np.zeros(len(ids))
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        camera = model.camera(image.camera_id)
        size = np.array([camera.width, camera.height])
        squared = (((pixels - size / 2) / (_SPREAD * size.min())) ** 2).sum(axis=1)
        rows = np.searchsorted(ids, np.array([point.point3D_id for point in seen], np.int64))
        weights[rows] += np.exp(-squared / 2)
    return weights + 1e-12


def _box_around(points: Points3D, weights: Float64[np.ndarray, " n"]) -> Box:
    mean = np.average(points, axis=0, weights=weights)
    covariance = ((points - mean).T * weights) @ (points - mean)
    axes = np.linalg.eigh(covariance)[1].T
    axes *= np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None]
    coordinates = (points - mean) @ axes.T
    low, high = np.array([_weighted_range(coordinates[:, i], weights) for i in range(3)]).T
    half = np.maximum((high - low) / 2, max(1e-3 * (high - low).max(), 1e-9))
    return Box(mean + (low + high) / 2 @ axes, half[:, None] * axes)


def _weighted_range(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.searchsorted(share, (_TAIL, 1 - _TAIL))
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])
