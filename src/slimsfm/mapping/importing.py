"""Import COLMAP models as maps: the model does not change, its keypoints get their descriptors."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.devices import Device
from slimsfm.errors import ModelError
from slimsfm.exif import read_device, read_orientation
from slimsfm.features import Features
from slimsfm.features.store import stored_name
from slimsfm.files import inside
from slimsfm.mapping.agreement import Masks, counted, place_features
from slimsfm.mapping.cameras import devices_by_camera
from slimsfm.mapping.descriptors import with_global_descriptors
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.mapping.model import camera_of, estimate_box, positions, read_box, read_model
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.reprojection import check_reprojection
from slimsfm.mapping.resemblance import check_descriptors
from slimsfm.mapping.sources import (
    Source,
    check_extractor,
    database_of,
    databases_near,
    from_database,
    from_hloc,
    from_images,
)
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.mapping.usable_matches import evidence, usable_matches
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Source of the descriptors of a model's keypoints: at most one of the first three."""

    database: Path | None = None
    """The model's COLMAP database. Without any source, database.db is searched for next to the model."""

    features: Path | None = None
    """hloc's features.h5."""

    images: Path | None = None
    """Folder of the model's images, to compute SIFT descriptors at the model's keypoints."""

    matches: Path | None = None
    """hloc's matches.h5; requires `features`."""

    extractor: str = "sift"
    """Extractor of `features`, which is also used for queries. Needs `features`."""

    orientation: Orientation = "stored"
    """Which pixels of the image files the model is of: as they are stored, as in COLMAP and hloc, or turned
    upright according to EXIF. Queries are read alike."""

    box: Path | None = None
    """File with the object's box: JSON or OnePose's box3d_corners.txt. Estimated by default."""

    def __post_init__(self) -> None:
        given = [name for name in ("database", "features", "images") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)}: give only one source of descriptors")
        if self.matches is not None and self.features is None:
            raise ValueError("matches needs features, which hold the matched keypoints")
        if self.extractor != "sift" and self.features is None:
            raise ValueError(
                f"extractor={self.extractor!r} needs features; databases name theirs, and images get SIFT's"
            )

    def paths(self, model_path: Path) -> list[Path]:
        """The files and folders that an import of a model reads besides it."""
        given = (self.database, self.features, self.images, self.matches, self.box)
        found = [] if self.database or self.features or self.images else databases_near(model_path)
        return [*(path for path in given if path), *found]


_FARTHEST_PX = 1e9  # coordinate of a keypoint; beyond, it is no position


def import_colmap(
    model_path: str | Path,
    images: str | Path | None = None,
    options: ImportOptions = ImportOptions(),
    *,
    progress: ProgressBar = silent,
) -> Map:
    """Import a COLMAP model, binary or text, with or without rigs and frames, as a map.

    Ids, names, cameras, poses and points do not change. The descriptors come from the COLMAP database next to
    the model, unless another source is given.

    Args:
        model_path: Folder with cameras, images and points3D.
        images: Folder of the model's images, to compute SIFT descriptors; short for `ImportOptions.images`.
        options: Source of the descriptors, and the box.
        progress: Progress callback.

    Raises:
        ModelError: The model is damaged, or its keypoints are not those of the features.
        InputError: A file is missing or damaged; a few photos may be, whose images are left out.
    """
    model_path = Path(model_path)
    if images is not None:
        options = replace(options, images=Path(images))
    model = read_model(model_path)
    given_box = read_box(options.box) if options.box else None
    posed = _posed_images(model)
    unusable, notes = _drop_unplaced(model, posed)
    _check_content(model, posed, model_path)
    notes += check_reprojection(model, posed, model_path)
    source = _find_source(model_path, posed, options, progress)
    check_extractor(source)
    if options.images:  # without the images whose photo cannot be read
        posed = [image for image in posed if image.name in source.features]
    features, more = _fitting_features(posed, source, unusable)
    matches, left_out = usable_matches(source, posed, features, unusable)
    info = MapInfo(
        extractor=source.extractor,
        extractor_options=source.extractor_options,
        box=given_box or estimate_box(model),
        box_source="given" if given_box else "estimated",
        origin=f"imported COLMAP model with descriptors from {source.origin}",
        quality=_quality(model, evidence(source, posed, features, matches)) if matches else None,
        notes=(*notes, *source.notes, *more, *left_out),
        orientation=options.orientation,
        exif_orientations=_tags(posed, options),
        devices=_devices(model, posed, options),
    )
    whole = Map(model=model, features=features, matches=matches, info=info)
    is_whole = len(whole.images) == len(posed)
    return with_global_descriptors(whole if is_whole else keep_images(whole, [one.name for one in posed]))


def _quality(model: pycolmap.Reconstruction, matches: Matches) -> ModelQuality:
    quality = measure(model, matches, [image.name for image in model.images.values()])
    return replace(quality, focal_origins=dict.fromkeys(quality.focal_lengths, "model"))


def _tags(images: list[pycolmap.Image], options: ImportOptions) -> dict[str, int]:
    if options.orientation == "stored" or options.images is None:
        return {}
    tags = {image.name: read_orientation(inside(options.images, image.name)) for image in images}
    return {name: tag for name, tag in tags.items() if tag != 1}


def _devices(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image], options: ImportOptions
) -> dict[int, Device]:
    if options.images is None:
        return {}
    names = [image.name for image in images]
    return devices_by_camera(model, {name: read_device(inside(options.images, name)) for name in names})


def _find_source(
    model_path: Path, images: list[pycolmap.Image], options: ImportOptions, progress: ProgressBar
) -> Source:
    if options.features:
        return from_hloc(images, options.features, options.matches, options.extractor)
    if options.images:
        return from_images(images, options.images, progress, options.orientation)
    return from_database(images, options.database or database_of(model_path))


def _posed_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)


def _check_content(model: pycolmap.Reconstruction, images: list[pycolmap.Image], path: Path) -> None:
    if not model.num_points3D():
        raise ModelError(f"{path}: the model has no 3D points; triangulate it first")
    if not model.compute_num_observations():
        raise ModelError(
            f"{path}: no image of the model observes a 3D point; triangulate it again with its images"
        )
    stored: dict[str, str] = {}
    for name in (image.name for image in images):
        other = stored.setdefault(stored_name(name), name)
        if other != name or not stored_name(name):
            raise ModelError(
                f"{path}: the images {other!r} and {name!r} cannot be stored apart; rename one of them"
            )


def _drop_unplaced(model: pycolmap.Reconstruction, images: list[pycolmap.Image]) -> tuple[Masks, list[str]]:
    """Move keypoints without a finite position, which COLMAP's undistorter leaves, to (0, 0).

    Returns:
        The mask of these keypoints by image name, and a note. They observe nothing.
    """
    unusable, observations = {}, 0
    for image in images:
        unusable[image.name] = ~(np.abs(positions(image)) < _FARTHEST_PX).all(axis=1)
        for row in np.flatnonzero(unusable[image.name]).tolist():
            if image.points2D[row].has_point3D():
                model.delete_observation(image.image_id, row)
                observations += 1
            image.points2D[row].xy = np.zeros(2)
    counts = {name: int(mask.sum()) for name, mask in unusable.items() if mask.any()}
    if not counts:
        return unusable, []
    note = (
        f"{sum(counts.values())} keypoints of {counted(counts, len(images))} in the model have no finite "
        f"position; they were moved to (0, 0) and match nothing, and {observations} observations were dropped"
    )
    return unusable, [note]


def _fitting_features(
    images: list[pycolmap.Image], source: Source, unusable: Masks
) -> tuple[dict[str, Features], list[str]]:
    """The features of all images, checked against the model; images without keypoints have none."""
    with_keypoints = [image for image in images if image.num_points2D()]
    features, notes = place_features(with_keypoints, source.features, unusable, source.path)
    check_descriptors(with_keypoints, features, source.path)
    width = next(iter(features.values())).descriptors
    empty = [image for image in images if not image.num_points2D()]
    for image in empty:
        camera = camera_of(image)
        features[image.name] = Features(
            keypoints=np.zeros((0, 2), np.float32),
            descriptors=width[:0],
            scores=np.zeros(0, np.float32),
            image_size=(camera.width, camera.height),
        )
    if empty:
        names = [image.name for image in empty]
        notes.append(f"{counted(names)} have no keypoints in the model and match nothing")
    return features, notes
