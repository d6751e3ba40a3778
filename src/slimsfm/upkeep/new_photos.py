"""Photos that are to be added to a map: which are new, their features, and what is known of their cameras."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from scipy.spatial import KDTree

from slimsfm.errors import InputError
from slimsfm.exif import Exif, read_exif
from slimsfm.features import Features, load_extractor, unit_rows
from slimsfm.image_files import check_names
from slimsfm.localization.cameras import QueryCamera, query_camera
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.extraction import Extracted, extract_features
from slimsfm.mapping.map import Map
from slimsfm.mapping.masked_photos import MaskedPhotos, find_photos
from slimsfm.mapping.work import files_key
from slimsfm.mapping.workspace import Workspace
from slimsfm.progress import ProgressBar, silent
from slimsfm.skipping import SkippedPhotos

_NEAR_PX, _ALIKE, _SAME = 1.0, 0.9, 0.5  # distance and cosine of features; share of them in the same photo


@dataclass(frozen=True, kw_only=True, eq=False)
class NewPhotos:
    """Photos that are to be added to a map."""

    names: tuple[str, ...]
    """Those that are not in the map, sorted."""

    known: tuple[str, ...]
    """Those that are in the map already."""

    extracted: Extracted
    """Features of all of them, and their colors."""

    exifs: Mapping[str, Exif]
    """EXIF data by name."""

    cameras: Mapping[str, QueryCamera]
    """What is known of the intrinsics of the new ones, by name."""

    notes: tuple[str, ...]
    """Sentences, with names, on what was skipped or ignored."""

    workspace: Workspace
    """Where their features are, and where matches are kept."""


def read_new_photos(
    map: Map,
    images: Path,
    folder: Path,
    *,
    matcher: str = "nearest",
    strict: bool = False,
    workers: Workers = Workers(),
    progress: ProgressBar = silent,
) -> NewPhotos:
    """Extract the features of photos as those of a map were extracted.

    Args:
        map: The map.
        images: Folder of photos, or one photo.
        folder: Folder of intermediate files, which an interrupted call left.
        matcher: What the features are for.
        strict: Raise the error of the first photo that cannot be read, instead of skipping it.
        workers: Who extracts.
        progress: Progress callback.

    Raises:
        InputError: There is no photo, or the map has another one of the same name.
        ImageError: No photo can be read or, if `strict`, one cannot.
    """
    root, found, notes = _found(images)
    check_names(root, found)
    extractor = load_extractor(map.info.extractor, map.info.extractor_options)
    photos = MaskedPhotos(root, found, orientation=map.info.orientation)
    workspace = Workspace(folder, _key(map, photos, root, found, matcher))
    skipped = SkippedPhotos(root, strict=strict)
    exifs, cameras = {}, {}
    for name in found:
        with skipped.skipping(name):
            exifs[name] = read_exif(root / name)
            cameras[name] = query_camera(map, root / name, None)
    extracted = extract_features(
        photos, skipped.left(found), extractor, workspace, skipped, workers, progress
    )
    left = skipped.left(found)
    known = tuple(name for name in left if name in map.images)
    for name in known:
        _check_same(map, root, name, extracted.features[name])
    names = tuple(name for name in left if name not in map.images)
    said = dict.fromkeys(note for name in names for note in cameras[name].notes)
    return NewPhotos(
        names=names,
        known=known,
        extracted=extracted,
        exifs=exifs,
        cameras={name: cameras[name] for name in names},
        notes=(*notes, *skipped.notes, *photos.notes, *said),
        workspace=workspace,
    )


def _found(images: Path) -> tuple[Path, list[str], tuple[str, ...]]:
    if images.is_file():
        return images.parent, [images.name], ()
    found = find_photos(images, None)
    if not found.names:
        raise InputError("; ".join([f"{images}: holds no images", *found.notes]))
    return images, list(found.names), found.notes


def _key(map: Map, photos: MaskedPhotos, root: Path, names: list[str], matcher: str) -> dict[str, Any]:
    """All that features and matches depend on."""
    return {
        "versions": [version("slimsfm"), pycolmap.__version__, cv2.__version__],
        "images": [os.path.realpath(root), *names],
        "map": map.fingerprint,
        **files_key(photos, names, map.info.extractor, matcher),
    }


def _check_same(map: Map, root: Path, name: str, found: Features) -> None:
    """Check that a photo is the one of the same name in the map."""
    if not _is_same(map.features[name], found):
        raise InputError(
            f"{root / name}: the map has another image of this name; rename the photo, or put it into a "
            "folder of its own name"
        )


def _is_same(old: Features, new: Features) -> bool:
    """Whether most features of an image of a map, which may have been masked, are those of a photo."""
    if not len(old) or not len(new):
        return len(old) == len(new)
    distances, rows = KDTree(new.keypoints).query(old.keypoints)
    near = np.asarray(distances) <= _NEAR_PX
    if old.descriptors.shape[1] != new.descriptors.shape[1] or not near.any():
        return False
    a, b = unit_rows(old.descriptors[near]), unit_rows(new.descriptors[np.asarray(rows)[near]])
    return float((np.einsum("nd,nd->n", a, b) >= _ALIKE).sum()) >= _SAME * len(old)
