"""Data sets whose poses come from Structure from Motion: a folder of photos, or a COLMAP model.

All images are reconstructed together, and these poses serve as (pseudo) ground truth. Then the queries are
held out: their keypoints are removed, and so is every point that fewer than two of the remaining images
observe. The result is a map without any trace of the queries.

    PROJECT/sparse/0/    a COLMAP model, binary or text; or any other folder that holds one
    PROJECT/database.db  COLMAP's database with the descriptors; optional
    IMAGES/              the images of the model, under their names in the model
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slimsfm.datasets.base import TWO_VIEWS, LoadOptions, ObjectSequences, PosedSequence
from slimsfm.datasets.reading import check_object_name, image_size
from slimsfm.errors import ImageError, InputError
from slimsfm.files import inside
from slimsfm.image_files import find_images, is_image, list_images
from slimsfm.mapping.build import build_map
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.known_poses.values import read_text
from slimsfm.mapping.map import Map

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Images:
    """Photos with unknown poses: all are reconstructed together, and every n-th is a query."""

    path: Path
    """Folder with photos of one object, or with one folder of photos per object."""

    query_every: int = 3
    """Every n-th image in the order of names, starting with the first, is a query; the rest are for
    mapping."""

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects: the names of their folders."""
        if self._holds_photos():
            return (self.path.resolve().name,)
        photos = find_images(self.path).names
        return tuple(sorted({name.split("/")[0] for name in photos}))

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:
        """Reconstruct all photos of an object, or read the reconstruction of an earlier call.

        The log names the photos that the reconstruction leaves out.
        """
        check_object_name(name, self.names(), self.path)
        folder = self.path if self._holds_photos() else self.path / name
        query_names(list(find_images(folder).names), self.query_every)  # checked before the long work
        truth = _pseudo_ground_truth(folder, options)
        return _split(truth, name, folder, query_names(list(truth.images), self.query_every))

    def _holds_photos(self) -> bool:
        return self.path.is_dir() and any(is_image(path) for path in self.path.iterdir())


@dataclass(frozen=True, kw_only=True)
class Colmap:
    """A COLMAP model, some of whose images are queries. Its frame and unit stay as they are.

    Descriptors come from hloc's features or from a COLMAP database, given or found in the project. Without
    both, SIFT descriptors are computed from the images.
    """

    path: Path
    """Folder of the model, such as PROJECT/sparse/0."""

    images: Path
    """Folder of its images."""

    queries: Path | None = None
    """Text file with the names of the query images, one per line; the rest of a line is ignored, as in hloc's
    lists. Without this file, every n-th image is a query."""

    query_every: int = 3
    """Without a list of queries, every n-th image in the order of names, starting with the first, is one."""

    database: Path | None = None
    """COLMAP database of the model; the one in its project by default."""

    features: Path | None = None
    """hloc's features.h5, instead of a database."""

    matches: Path | None = None
    """hloc's matches.h5 for `features`."""

    extractor: str = "sift"
    """Name of the extractor that computed `features`."""

    box: Path | None = None
    """Box of the object: JSON or OnePose's box3d_corners.txt; estimated by default."""

    def __post_init__(self) -> None:
        ImportOptions(
            database=self.database, features=self.features, matches=self.matches, extractor=self.extractor
        )

    def names(self) -> tuple[str, ...]:
        """The only object, named after the folder of the project or, without one, of the model."""
        return (self._project.name,)

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:
        """Import the model and split off the queries."""
        check_object_name(name, self.names(), self.path)
        truth = import_colmap(self.path, options=self._import_options(), progress=options.progress)
        for one in truth.images:
            self._check_image(truth, one)
        listed = self.queries
        queries = (
            _listed_queries(listed, truth) if listed else query_names(list(truth.images), self.query_every)
        )
        return _split(truth, name, self.images, queries)

    @property
    def _project(self) -> Path:
        """The parent of the folders that COLMAP creates for its models."""
        path = self.path.resolve()
        while path.name.isdecimal() or path.name == "sparse":
            path = path.parent
        return path

    def _import_options(self) -> ImportOptions:
        database = self.database
        if database is None and self.features is None:
            places = [folder / "database.db" for folder in (self.path, self._project)]
            database = next((place for place in places if place.is_file()), None)
        return ImportOptions(
            database=database,
            features=self.features,
            images=None if database or self.features else self.images,
            matches=self.matches,
            extractor=self.extractor,
            box=self.box,
        )

    def _check_image(self, truth: Map, name: str) -> None:
        path, camera = inside(self.images, name), truth.camera(name)
        if (size := image_size(path, truth.info.orientation)) != (camera.width, camera.height):
            raise ImageError(
                f"{path} has {size[0]}x{size[1]} pixels, but its camera in the model "
                f"{camera.width}x{camera.height}: pass the images that the model was computed from"
            )


def _listed_queries(path: Path, truth: Map) -> list[str]:
    """The images that a text file lists.

    Raises:
        InputError: The file lists no image or one without a pose, or fewer than two images are left for
        mapping.
    """
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    queries = {line if line in truth.images else line.split()[0] for line in lines}
    if unknown := sorted(queries - truth.images.keys()):
        raise InputError(f"{path}: lists {unknown[0]!r}, which has no pose in the model; remove it")
    if not queries or len(truth.images) - len(queries) < TWO_VIEWS:
        raise InputError(
            f"{path}: lists {len(queries)} of the {len(truth.images)} images of the model; "
            "at least one query and two mapping images are required"
        )
    return sorted(queries)


def query_names(names: list[str], every: int) -> list[str]:
    """Every n-th name in sorted order, starting with the first.

    Raises:
        InputError: There is no query, or fewer than two references are left.
    """
    queries = sorted(names)[::every] if every >= 1 else []
    references = len(names) - len(queries)
    if not queries or references < TWO_VIEWS:
        raise InputError(
            f"`query_every={every}` leaves {references} reference{'' if references == 1 else 's'} of "
            f"{len(names)} images; at least one query and two references are required"
        )
    return queries


def _split(truth: Map, name: str, folder: Path, queries: Sequence[str]) -> ObjectSequences:
    """Split the images of a map into queries and mapping images; its poses serve as ground truth."""
    chosen = set(queries)
    mapping, query = ([one for one in truth.images if (one in chosen) is held] for held in (False, True))
    return ObjectSequences(
        name=name,
        mapping=_sequence(truth, folder, mapping),
        query=_sequence(truth, folder, query),
        box=truth.box,
        unit=truth.info.unit,
        truth=truth,
    )


def _sequence(truth: Map, folder: Path, names: Sequence[str]) -> PosedSequence:
    return PosedSequence(
        folder=folder,
        names=tuple(names),
        cameras=tuple(truth.camera(name) for name in names),
        cam_from_world=tuple(truth.images[name].cam_from_world() for name in names),
        orientation=truth.info.orientation,
    )


def _pseudo_ground_truth(folder: Path, options: LoadOptions) -> Map:
    """The map of all photos of a folder, from an earlier call or built and stored now.

    Raises:
        InputError: The stored map has other photos.
    """
    names, path = set(list_images(folder)), options.folder / "pseudo-ground-truth"
    if not path.exists():
        write_map(build_map(folder, options.build, progress=options.progress), path)
    truth = read_map(path)
    if unknown := truth.images.keys() - names:
        raise InputError(
            f"{path}: has other images ({min(unknown)} is not in {folder}); choose another output folder"
        )
    if left_out := sorted(names - truth.images.keys()):
        _LOGGER.warning("%s: not registered and so left out: %s", folder, ", ".join(left_out))
    return truth
