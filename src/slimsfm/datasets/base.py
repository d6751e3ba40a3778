"""The interface of data sets: objects, each with images for mapping and images to localize."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import pycolmap

from slimsfm.arrays import Points3D
from slimsfm.geometry import Box
from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent

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

    @property
    def image_paths(self) -> tuple[Path, ...]:
        """Paths of the image files."""
        return tuple(self.folder / name for name in self.names)


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectModel:
    """A 3D model of an object. If a data set has one, it defines the pose errors."""

    vertices: Points3D
    """Vertices in the frame of the object."""

    diameter: float
    """Largest distance between two vertices, in the unit of the frame."""

    symmetric: bool
    """Whether poses with equal appearance count as equal: errors then use the nearest vertex."""


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
