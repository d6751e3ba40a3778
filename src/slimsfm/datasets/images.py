"""Any folder of photos as a data set with pseudo ground truth.

No pose is known, so all images are reconstructed together, and the poses that this gives are taken for true.
Then the queries are held out: their keypoints go, and with them every point that fewer than two of the
remaining images observe. What is left is a map that knows nothing of them.
"""

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slimsfm.datasets.base import Making, ObjectSequences, PosedSequence
from slimsfm.datasets.reading import check_known
from slimsfm.errors import InputError
from slimsfm.mapping.build import build_map
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import SUFFIXES, list_images

_LOGGER = logging.getLogger(__name__)
_TWO_VIEWS = 2


@dataclass(frozen=True, kw_only=True)
class Images:
    """Photos of unknown pose: reconstructed all together, every n-th is a query."""

    path: Path
    """Folder of photos of one object, or else of folders of photos, each of an object of its own."""

    query_every: int = 3
    """Every n-th image in order of name, from the first, is a query; the rest map."""

    def names(self) -> tuple[str, ...]:
        """The objects, called as their folders, sorted."""
        if self._holds_photos():
            return (self.path.resolve().name,)
        photos = list_images(self.path)
        return tuple(sorted({name.split("/")[0] for name in photos}))

    def load(self, name: str, making: Making) -> ObjectSequences:
        """Reconstruct all photos of an object, or read what was made of them before.

        Photos that the reconstruction leaves out are told of in the log.
        """
        check_known(name, self.names(), self.path)
        folder = self.path if self._holds_photos() else self.path / name
        query_names(list_images(folder), self.query_every)  # refused before the long work, not after
        truth = _pseudo_ground_truth(folder, making)
        return sequences_of(truth, name, folder, query_names(list(truth.images), self.query_every))

    def _holds_photos(self) -> bool:
        return self.path.is_dir() and any(
            path.suffix.lower() in SUFFIXES and not path.name.startswith(".") for path in self.path.iterdir()
        )


def query_names(names: list[str], every: int) -> list[str]:
    """Of the names in order every n-th one, starting with the first.

    Raises:
        InputError: No query or fewer than two references would be left.
    """
    queries = sorted(names)[::every] if every >= 1 else []
    if not queries or len(names) - len(queries) < _TWO_VIEWS:
        raise InputError(
            f"`query_every={every}` leaves {len(names) - len(queries)} references of {len(names)} images; "
            "two are needed"
        )
    return queries


def sequences_of(truth: Map, name: str, folder: Path, queries: Sequence[str]) -> ObjectSequences:
    """The object of a map of all images: the queries are some of them, the others map.

    Args:
        truth: The map, whose poses are taken for true.
        name: The object's.
        folder: Holds the images.
        queries: Names of images of the map.
    """
    asked = set(queries)
    mapping, query = ([one for one in truth.images if (one in asked) is held] for held in (False, True))
    return ObjectSequences(
        name=name,
        mapping=_sequence(truth, folder, mapping),
        query=_sequence(truth, folder, query),
        box=truth.box,
        unit=truth.info.unit,
        truth=truth,
    )


def hold_out(ground_truth: Map, queries: list[str]) -> Map:
    """The map without the queries: of the other images, and the points that two of them observe."""
    held_out = set(queries)
    references = [name for name in ground_truth.images if name not in held_out]
    return keep_images(ground_truth, references, min_track_length=_TWO_VIEWS)


def _sequence(truth: Map, folder: Path, names: Sequence[str]) -> PosedSequence:
    return PosedSequence(
        folder=folder,
        names=tuple(names),
        cameras=tuple(truth.camera(name) for name in names),
        cam_from_world=tuple(truth.images[name].cam_from_world() for name in names),
    )


def _pseudo_ground_truth(folder: Path, making: Making) -> Map:
    """The map of all photos of a folder: the one that is kept, or else a new one, which is then kept.

    Raises:
        InputError: The one that is kept is of other photos.
    """
    names, path = set(list_images(folder)), making.folder / "pseudo-ground-truth"
    if not path.exists():
        with tempfile.TemporaryDirectory(prefix="slimsfm-build-") as workspace:
            made = build_map(folder, Path(workspace), making.build, progress=making.progress)
            write_map(made.map, path)
    truth = read_map(path)
    if strangers := truth.images.keys() - names:
        raise InputError(
            f"{path}: is of other images ({min(strangers)} is not in {folder}); choose another output folder"
        )
    if left_out := sorted(names - truth.images.keys()):
        _LOGGER.warning("%s: not in the model and so left out: %s", folder, ", ".join(left_out))
    return truth
