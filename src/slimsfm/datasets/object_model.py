"""Models of objects that come with data sets: PLY files, and what is listed of them beside."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from slimsfm.arrays import Points3D
from slimsfm.datasets.base import ObjectModel
from slimsfm.errors import InputError
from slimsfm.geometry import Box

MILLIMETRE = 1e-3
"""In metres."""

_METRES = {"metre": 1.0, "millimetre": MILLIMETRE}
_FEWEST_VERTICES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ListedModel:
    """What BOP's models_info lists of a model."""

    box: Box
    """Its axis-aligned box, in metres."""

    diameter: float
    """Largest distance of two of its vertices, in metres."""

    @classmethod
    def from_millimetres(cls, listed: Mapping[str, Any], source: str) -> "ListedModel":
        """Take min_x, size_x, diameter and so on, which are in millimetres.

        Raises:
            InputError: One is missing or cannot be; the message names the source.
        """
        keys = [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"] + ["diameter"]
        try:
            values = MILLIMETRE * np.array([float(listed[key]) for key in keys])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{source} must have {', '.join(keys)}, each a number") from error
        low, size, diameter = values[:3], values[3:6], float(values[6])
        if not (np.all(np.isfinite(values)) and np.all(size > 0) and diameter > 0):
            raise InputError(f"{source} must have finite minima and a positive size and diameter")
        box = Box(low + size / 2, np.diag(size / 2))
        check_size(diameter, box, f"{source} has a diameter that")
        return cls(box=box, diameter=diameter)


def read_object_model(
    path: Path,
    box: Box,
    *,
    unit: Literal["metre", "millimetre"] = "metre",
    diameter: float | None = None,
    symmetric: bool,
) -> ObjectModel:
    """Read the model of an object from a PLY file.

    Args:
        path: The file, text or binary, a mesh or a cloud of points.
        box: The object's box, in metres; a model of quite another size is in another unit and refused.
        unit: Of the vertices in the file.
        diameter: Known diameter, in metres; None computes it.
        symmetric: Whether poses that look alike count as equal.

    Raises:
        InputError: The file is missing or damaged, or the model is not about as large as the box.
    """
    vertices = _METRES[unit] * read_vertices(path)
    check_size(float(np.linalg.norm(np.ptp(vertices, axis=0))), box, f"{path}, in {unit}s,")
    if diameter is None:
        diameter = largest_distance(vertices)
    return ObjectModel(vertices=vertices, diameter=diameter, symmetric=symmetric)


def check_size(extent: float, box: Box, what: str) -> None:
    """Make sure that something is about as large as the object's box.

    Raises:
        InputError: It is not, so it must be in another unit.
    """
    ratio = extent / box.diagonal
    if not 0.4 < ratio < 2.5:
        raise InputError(f"{what} is {ratio:.3g} times as large as the object's box: check the unit")


def read_vertices(path: Path) -> Points3D:
    """The vertices of a PLY file, in its unit.

    Raises:
        InputError: It is missing or damaged, or holds fewer than four.
    """
    from trimesh.exchange.ply import load_ply  # slow to import, and few data sets have models

    try:
        with path.open("rb") as file:
            found = load_ply(file, fix_texture=False, skip_materials=True)["vertices"]
            vertices = np.array(found, np.float64)
    except FileNotFoundError as error:
        raise InputError(f"{path} cannot be read: there is no such file") from error
    except Exception as error:  # damaged files make trimesh fail in many ways
        raise InputError(f"{path} cannot be read as a PLY file: {error}") from error
    shape = vertices.shape
    if len(shape) != 2 or shape[1] != 3 or shape[0] < _FEWEST_VERTICES or not np.all(np.isfinite(vertices)):
        raise InputError(f"{path} must hold at least four finite vertices, got shape {shape}")
    return vertices


def largest_distance(points: Points3D) -> float:
    """The largest distance of two of the points, which are corners of their convex hull."""
    corners = ConvexHull(points, qhull_options="QJ").vertices  # joggled, for points may lie in a plane
    return float(pdist(points[corners]).max())
