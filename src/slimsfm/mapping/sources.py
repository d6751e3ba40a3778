"""Where the descriptors of a model's keypoints come from: a COLMAP database, hloc's files, or the images."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError, ModelError
from slimsfm.features import Features
from slimsfm.features.registry import EXTRACTORS, extractor_entry
from slimsfm.features.store import FeatureFile, MatchFile, indistinct_names
from slimsfm.mapping.agreement import counted
from slimsfm.mapping.database import read_database
from slimsfm.mapping.redescription import redescribe
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """Features of a model's images and, if there are any, matches."""

    path: Path
    """The file or folder that they come from."""

    features: dict[str, Features]
    """By image name; images without any keypoint may be missing."""

    matches: Mapping[tuple[str, str], IndexPairs]
    """By pair of image names."""

    unverified: Path | None = None
    """The file of the matches if they did not pass two-view geometry."""

    extractor: str
    """Name of the extractor."""

    extractor_options: dict
    """Options of the extractor."""

    origin: str
    """What the source is, for the origin of the map."""

    notes: tuple[str, ...] = ()
    """What was guessed or scaled."""


def databases_near(model_path: Path) -> list[Path]:
    """The databases where COLMAP places them: PROJECT/database.db for PROJECT/sparse/0."""
    folders = [model_path, *model_path.absolute().parents[:2]]
    return [path for folder in folders if (path := folder / "database.db").is_file()]


def database_of(model_path: Path) -> Path:
    """Find the database of a model.

    Raises:
        InputError: There is none.
    """
    found = databases_near(model_path)
    if not found:
        raise InputError(
            f"{model_path}: no database.db next to the model; give the source of its descriptors: "
            "`database=FILE`, `features=FILE` (hloc) or `images=DIR`"
        )
    return found[0]


def from_database(images: list[pycolmap.Image], path: Path) -> Source:
    """Read features and verified matches from a COLMAP database.

    Raises:
        InputError: The file is missing, damaged or no COLMAP database.
        ModelError: It lacks the features of an image.
    """
    contents = read_database(path, [image.name for image in images])
    _check_present(images, contents.features, path)
    extractor, notes = contents.extractor.lower().split("_")[0], ()
    if not contents.matches:
        notes = (f"{path.name}: holds no verified matches of these images, so the map has none",)
    if extractor != "sift":
        notes = (
            *notes,
            f"{path.name}: the features are {contents.extractor}'s; queries get those of {extractor!r} with "
            "its default weights, which must be the same",
        )
    return Source(
        path=path,
        features=contents.features,
        matches=contents.matches,
        extractor=extractor,
        extractor_options={},
        origin="its database",
        notes=notes,
    )


def from_hloc(images: list[pycolmap.Image], path: Path, matches: Path | None, extractor: str) -> Source:
    """Read hloc's features and, if given, its unverified matches.

    Raises:
        InputError: A file is missing, damaged or of another kind.
        ModelError: The features lack an image, or the matches lack all pairs.
    """
    extractor_entry(extractor)
    stored = FeatureFile(path, [image.name for image in images], finite=False)
    if not stored:
        raise InputError(f"{path}: holds no features (groups with `keypoints`); give hloc's features.h5")
    features = {image.name: stored[image.name] for image in images if image.name in stored}
    _check_present(images, features, path)
    found, notes = {}, ()
    if matches:
        if indistinct := [name for name in indistinct_names(stored) if name in features]:
            raise InputError(
                f"{matches}: cannot tell {counted(indistinct)} from names that have - instead of /; "
                "leave `matches` out"
            )
        found = MatchFile(matches, sorted(features))
        notes = _check_pairs(matches, found)
    return Source(
        path=path,
        features=features,
        matches=found,
        unverified=matches,
        extractor=extractor,
        extractor_options={},
        origin="hloc's features",
        notes=notes,
    )


def _check_pairs(path: Path, found: MatchFile) -> tuple[str, ...]:
    if not found and not found.num_other_pairs:
        raise InputError(f"{path}: holds no matches (groups with `matches0`); give hloc's matches.h5")
    if not found:
        raise ModelError(
            f"{path}: none of its {found.num_other_pairs} pairs is of two images of the model; give the "
            "matches of its images"
        )
    if found.num_other_pairs:
        return (
            f"{path.name}: {found.num_other_pairs} pairs are not of two images of the model and were ignored",
        )
    return ()


def from_images(
    images: list[pycolmap.Image], folder: Path, progress: ProgressBar, orientation: Orientation = "stored"
) -> Source:
    """Compute SIFT descriptors at the model's keypoints.

    Raises:
        InputError: The folder or an image is missing or unusable.
        ModelError: The photos are others than the model's, or it does not use SIFT.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    features, extractor, notes = redescribe(images, folder, progress, orientation)
    return Source(
        path=folder,
        features=features,
        matches={},
        extractor=extractor.name,
        extractor_options=extractor.options,
        origin="its images",
        notes=tuple(notes),
    )


def _check_present(images: list[pycolmap.Image], features: Mapping[str, Features], path: Path) -> None:
    wanted = [image.name for image in images if image.num_points2D()]
    if missing := [name for name in wanted if name not in features]:
        raise ModelError(
            f"{path}: has no features of {counted(missing, len(images))} of the model; give the features "
            "that the model was made from"
        )


def check_extractor(source: Source) -> None:
    """Check that descriptors can be those of their extractor.

    Raises:
        InputError: The extractor is unknown or finds no keypoints, or its descriptors have another length or
            other signs.
    """
    entry = extractor_entry(source.extractor)
    present = [one for one in source.features.values() if len(one)]
    if not entry.has_keypoints:
        raise InputError(
            f"extractor {source.extractor!r} finds no keypoints, so it has no descriptors to import"
        )
    lengths = sorted({one.descriptors.shape[1] for one in present})
    if len(lengths) != 1:
        raise InputError(
            f"{source.path}: holds descriptors of different lengths ({', '.join(map(str, lengths))})"
            if present
            else f"{source.path}: holds no descriptors"
        )
    signed = any(bool(np.any(one.descriptors < 0)) for one in present)
    fits_length, fits_sign = entry.descriptor_length in (None, *lengths), entry.signed in (None, signed)
    if fits_length and fits_sign:
        return
    known = [
        name
        for name, one in EXTRACTORS.items()
        if (one.descriptor_length, one.signed) == (lengths[0], signed)
    ]
    values = f"{lengths[0]} values, {'some of them negative' if signed else 'none of them negative'}"
    raise InputError(
        f"{source.path}: its descriptors have {values}, unlike those of {source.extractor!r}; name their "
        f"extractor by `extractor=NAME` (built in: {', '.join(known) or 'none has such'})"
    )
