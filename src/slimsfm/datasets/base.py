"""The interface of data sets: objects with images to map and to localize, and models of objects."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import pycolmap
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from slimsfm.arrays import Points3D
from slimsfm.errors import InputError
from slimsfm.files import contents_of, inside, read_bytes
from slimsfm.geometry import Box
from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectModel:
    """A 3D model of an object. If a data set has one, it defines the pose errors."""

    vertices: Points3D
    """Vertices in the frame of the object."""

    diameter: float
    """Largest distance between two vertices, in the unit of the frame."""

    symmetric: bool
    """Whether poses with equal appearance count as equal: errors then use the nearest vertex."""


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

    with contents_of(path, "cannot be read as a PLY file"):
        data = read_bytes(path)
        found = load_ply(BytesIO(data), fix_texture=False, skip_materials=True)["vertices"]
        vertices = np.array(found, np.float64)
        stated = re.search(rb"^element\s+vertex\s+(\d+)\s*$", data, re.MULTILINE)
        if stated is None or int(stated[1]) != len(vertices):
            raise ValueError(f"{len(vertices)} vertices are not as many as it states")
    shape = vertices.shape
    if len(shape) != 2 or shape[1] != 3 or shape[0] < _FEWEST_VERTICES or not np.all(np.isfinite(vertices)):
        raise InputError(f"{path} must hold at least four finite vertices, got shape {shape}")
    return vertices


def largest_distance(points: Points3D) -> float:
    """Largest distance between two points; both are vertices of the convex hull."""
    corners = ConvexHull(points, qhull_options="QJ").vertices  # joggled, because points may lie in a plane
    return float(pdist(points[corners]).max())


TWO_VIEWS = 2
"""A point needs observations in two images."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSequence:
    """Images with their cameras and poses."""

    folder: Path
    """Folder of the images."""

    names: tuple[str, ...]
    """Image files relative to the folder, in the order of the video."""

    cameras: tuple[pycolmap.Camera, ...]
    """Camera of each image."""

    cam_from_world: tuple[pycolmap.Rigid3d, ...]
    """Pose of each image; the world is the frame of the object."""

    orientation: Orientation = "upright"
    """Which pixels of the files cameras and poses are of."""

    @property
    def image_paths(self) -> tuple[Path, ...]:
        """Paths of the image files."""
        return tuple(inside(self.folder, name) for name in self.names)


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectSequences:
    """An object with its mapping images and its queries."""

    name: str
    """Name of the object."""

    mapping: PosedSequence
    """Images for mapping."""

    query: PosedSequence
    """Images to localize; disjoint from the mapping images."""

    box: Box
    """Box of the object, in the frame of the poses."""

    unit: str = "metre"
    """Unit of that frame: "metre", or "unknown" if SfM left the scale open."""

    model: ObjectModel | None = None
    """Model of the object, if the data set has one."""

    truth: Map | None = None
    """Map of all images that provides the poses; None if they come from another source."""


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """How a data set reconstructs images whose poses are unknown."""

    folder: Path
    """Folder that keeps the reconstruction of one object for the next call."""

    build: BuildOptions = BuildOptions()
    """How photos are reconstructed."""

    progress: ProgressBar = silent
    """Progress callback."""


@runtime_checkable
class Dataset(Protocol):
    """A data set in one layout."""

    @property
    def path(self) -> Path:
        """Folder of the data set."""
        ...

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects.

        Raises:
            InputError: The data set has no object.
        """
        ...

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:
        """Read and check one object.

        Raises:
            InputError: A file is missing or damaged; the message names the first one and what to do.
        """
        ...


def map_object(
    sequences: ObjectSequences,
    workspace: Path,
    options: BuildOptions = BuildOptions(),
    progress: ProgressBar = silent,
) -> Map:
    """Map the mapping images of an object, in the frame of the object.

    Points are triangulated from the known poses. If the poses come from a map with the same extractor, the
    result is that map without the queries.
    """
    truth = sequences.truth
    if truth is not None and truth.info.extractor == options.extractor:
        return hold_out(truth, list(sequences.query.names))
    known = KnownPoses(
        cameras=_numbered_cameras(sequences.mapping),
        cam_from_world=dict(zip(sequences.mapping.names, sequences.mapping.cam_from_world, strict=True)),
        box=sequences.box,
        unit=sequences.unit,
    )
    folder = sequences.mapping.folder
    options = replace(options, orientation=sequences.mapping.orientation)
    return build_map(folder, options, known=known, workspace=workspace, progress=progress)


def hold_out(truth: Map, queries: list[str]) -> Map:
    """The map without the queries: the other images, and the points that at least two of them observe."""
    held_out = set(queries)
    references = [name for name in truth.images if name not in held_out]
    return keep_images(truth, references, min_track_length=TWO_VIEWS)


def _numbered_cameras(sequence: PosedSequence) -> dict[str, pycolmap.Camera]:
    """The camera of each image; equal cameras share one ID."""
    numbers: dict[tuple, int] = {}
    cameras = {}
    for name, camera in zip(sequence.names, sequence.cameras, strict=True):
        key = (camera.model_name, camera.width, camera.height, camera.params.tobytes())
        number = numbers.setdefault(key, len(numbers) + 1)
        cameras[name] = pycolmap.Camera(camera.todict() | {"camera_id": number})
    return cameras
