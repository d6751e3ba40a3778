"""What every data set gives: objects, each with images that map it and images that ask for their pose."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import pycolmap

from slimsfm.arrays import Points3D
from slimsfm.geometry import Box
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSequence:
    """Images, by what they were taken and where the camera stood."""

    folder: Path
    """Holds the images."""

    names: tuple[str, ...]
    """Of the image files, relative to the folder, in the order of the video."""

    cameras: tuple[pycolmap.Camera, ...]
    """Of every image."""

    cam_from_world: tuple[pycolmap.Rigid3d, ...]
    """Of every image; the world is the frame of the object."""

    @property
    def image_paths(self) -> tuple[Path, ...]:
        """The image files."""
        return tuple(self.folder / name for name in self.names)


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectModel:
    """A model of an object, by which data sets that have one measure errors."""

    vertices: Points3D
    """In the frame of the object."""

    diameter: float
    """Largest distance of two vertices, in the unit of the frame."""

    symmetric: bool
    """Whether poses that look alike count as equal: errors are then taken to the nearest vertex."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectSequences:
    """An object, the images that map it and the images that ask for poses."""

    name: str
    """Its name."""

    mapping: PosedSequence
    """Images that map it."""

    query: PosedSequence
    """Images that are queries; none of them maps it."""

    box: Box
    """Its box, in the frame of the poses."""

    unit: str = "metre"
    """Of that frame: "metre", or "unknown" where SfM left the scale open."""

    model: ObjectModel | None = None
    """Its model, where the data set has one."""

    truth: Map | None = None
    """The map of all images that the poses come from; None where they are known otherwise."""


@dataclass(frozen=True, kw_only=True)
class Making:
    """How a data set does what it has to before its poses are known."""

    folder: Path
    """Where what takes long is kept for the next time; of one object alone."""

    build: BuildOptions = BuildOptions()
    """How photos are reconstructed."""

    progress: ProgressBar = silent
    """Told of long work."""


@runtime_checkable
class Dataset(Protocol):
    """A data set in one layout."""

    @property
    def path(self) -> Path:
        """Where it lies."""
        ...

    def names(self) -> tuple[str, ...]:
        """The objects, sorted.

        Raises:
            InputError: There is none.
        """
        ...

    def load(self, name: str, making: Making) -> ObjectSequences:
        """Read one object, and check it.

        Raises:
            InputError: A file is missing or damaged; the message names the first one and what to do.
        """
        ...
