"""3D models that come with data sets: PLY files, and the sizes that data sets list for them."""

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

MILLIMETER = 1e-3
"""One millimeter in meters."""

_METERS = {"meter": 1.0, "millimeter": MILLIMETER}
_FEWEST_VERTICES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ListedModel:
    """Box and diameter of a model, from BOP's models_info."""

    box: Box
    """Axis-aligned box, in meters."""

    diameter: float
    """Largest distance between two vertices, in meters."""

    @classmethod
    def from_millimeters(cls, listed: Mapping[str, Any], source: str) -> "ListedModel":
        """Convert the entries min_x, size_x, diameter and so on from millimeters.

        Raises:
            InputError: An entry is missing or invalid; the message names the source.
        """
        keys = [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"] + ["diameter"]
        try:
            values = MILLIMETER * np.array([float(listed[key]) for key in keys])
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
    unit: Literal["meter", "millimeter"] = "meter",
    diameter: float | None = None,
    symmetric: bool,
) -> ObjectModel:
    """Read the model of an object from a PLY file.

    Args:
        path: A PLY file, text or binary, with a mesh or a point cloud.
        box: Box of the object, in meters. A model of a very different size has another unit and is an error.
        unit: Unit of the vertices in the file.
        diameter: Known diameter, in meters; None computes it.
        symmetric: Whether poses with equal appearance count as equal.

    Raises:
        InputError: The file is missing or damaged, or the sizes of model and box differ a lot.
    """
    vertices = _METERS[unit] * read_vertices(path)
    check_size(float(np.linalg.norm(np.ptp(vertices, axis=0))), box, f"{path}, in {unit}s,")
    if diameter is None:
        diameter = largest_distance(vertices)
    return ObjectModel(vertices=vertices, diameter=diameter, symmetric=symmetric)


def check_size(extent: float, box: Box, what: str) -> None:
    """Check that an extent is similar to the diagonal of the object's box.

    Raises:
        InputError: The sizes differ a lot, which indicates different units.
    """
    ratio = extent / box.diagonal
    if not 0.4 < ratio < 2.5:
        raise InputError(f"{what} is {ratio:.3g} times as large as the object's box: check the unit")


def read_vertices(path: Path) -> Points3D:
    """The vertices of a PLY file, in the unit of the file.

    Raises:
        InputError: The file is missing or damaged, or holds fewer than four vertices.
    """
    from trimesh.exchange.ply import load_ply  # slow to import, and few data sets have models

    try:
        with path.open("rb") as file:
            found = load_ply(file, fix_texture=False, skip_materials=True)["vertices"]
            vertices = np.array(found, np.float64)
    except FileNotFoundError as error:
        raise InputError(f"{path} cannot be read: there is no such file") from error
    except Exception as error:  # trimesh raises many kinds of errors for damaged files
        raise InputError(f"{path} cannot be read as a PLY file: {error}") from error
    shape = vertices.shape
    if len(shape) != 2 or shape[1] != 3 or shape[0] < _FEWEST_VERTICES or not np.all(np.isfinite(vertices)):
        raise InputError(f"{path} must hold at least four finite vertices, got shape {shape}")
    return vertices


def largest_distance(points: Points3D) -> float:
    """Largest distance between two points; both are vertices of the convex hull."""
    corners = ConvexHull(points, qhull_options="QJ").vertices  # joggled, because points may lie in a plane
    return float(pdist(points[corners]).max())
