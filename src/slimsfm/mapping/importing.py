"""Import COLMAP models as maps: the model does not change, its keypoints get their descriptors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32, Int64

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError, ModelError
from slimsfm.exif import read_orientation
from slimsfm.features import Features, shrink_factor
from slimsfm.features.store import FeatureFile, MatchFile
from slimsfm.mapping.descriptors import with_global_descriptors
from slimsfm.mapping.extraction import redescribe
from slimsfm.mapping.map import Map, MapInfo
from slimsfm.mapping.model import camera_of, estimate_box, read_box, read_model
from slimsfm.mapping.sfm import colmap_warnings, verified_matches
from slimsfm.mapping.support import measure
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar, silent

_MIN_INLIERS = 15  # matches of a verified pair, as in COLMAP
_MAX_EPIPOLAR_ERROR_PX = 4.0  # in pixels in which features were found
_LONGEST_PX = {"max_image_size": 1600}  # hloc shrinks larger images to this or less before it finds features


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
    """Extractor of `features`, which is also used for queries."""

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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Source:
    """Descriptors and, if the source has them, matches."""

    features: Mapping[str, Features]
    matches: Mapping[tuple[str, str], IndexPairs]
    extractor: str
    extractor_options: dict
    origin: str


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
        InputError: A file is missing or damaged.
    """
    model_path = Path(model_path)
    if images is not None:
        options = replace(options, images=Path(images))
    model = read_model(model_path)
    given_box = read_box(options.box) if options.box else None
    if not model.num_points3D():
        raise ModelError(f"{model_path}: the model has no 3D points; triangulate it first")
    with colmap_warnings():
        source = _find_source(model_path, model, options, progress)
    _check_keypoints(model, source.features)
    info = MapInfo(
        extractor=source.extractor,
        extractor_options=source.extractor_options,
        box=given_box or estimate_box(model),
        box_source="given" if given_box else "estimated",
        origin=f"imported COLMAP model with descriptors from {source.origin}",
        orientation=options.orientation,
        exif_orientations=_tags(model, options),
    )
    if source.matches:
        quality = measure(model, source.matches, [image.name for image in model.images.values()])
        origins = dict.fromkeys(quality.focal_lengths, "model")
        info = replace(info, quality=replace(quality, focal_origins=origins))
    made = Map(model=model, features=source.features, matches=source.matches, info=info)
    return with_global_descriptors(made)


def _tags(model: pycolmap.Reconstruction, options: ImportOptions) -> dict[str, int]:
    if options.orientation == "stored" or options.images is None:
        return {}
    tags = {image.name: read_orientation(options.images / image.name) for image in _posed_images(model)}
    return {name: tag for name, tag in tags.items() if tag != 1}


def _find_source(
    model_path: Path, model: pycolmap.Reconstruction, options: ImportOptions, progress: ProgressBar
) -> _Source:
    if options.features:
        return _from_hloc(model, options)
    if options.images:
        return _from_images(model, options.images, options.orientation, progress)
    database = options.database or _database_next_to(model_path)
    return _from_database(model, database)


def _database_next_to(model_path: Path) -> Path:
    """Find the database as COLMAP places it: PROJECT/database.db for PROJECT/sparse/0."""
    folders = [model_path, *model_path.absolute().parents[:2]]
    found = [folder / "database.db" for folder in folders if (folder / "database.db").is_file()]
    if not found:
        raise InputError(
            f"{model_path}: no database.db next to the model; give the source of its descriptors: "
            "`database=FILE`, `features=FILE` (hloc) or `images=DIR`"
        )
    return found[0]


def _from_database(model: pycolmap.Reconstruction, path: Path) -> _Source:
    if not path.is_file():
        raise InputError(f"{path}: no such database")
    with path.open("rb") as file:
        header = file.read(16)
    if header != b"SQLite format 3\0":
        raise InputError(f"{path}: not a COLMAP database")
    try:
        return _read_database(model, path)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{path}: not readable as a COLMAP database, which must be complete and writable ({error})"
        ) from error


def _read_database(model: pycolmap.Reconstruction, path: Path) -> _Source:
    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        extractors = set()
        features = {}
        for image in _posed_images(model):
            if image.name not in ids or not database.exists_descriptors(ids[image.name]):
                raise ModelError(f"{path}: has no descriptors of image {image.name!r} of the model")
            features[image.name], extractor = _read_database_features(database, ids[image.name], image)
            extractors.add(extractor)
    if len(extractors) > 1:
        raise ModelError(f"{path}: holds features of several extractors ({', '.join(sorted(extractors))})")
    names = {image_id: name for name, image_id in ids.items() if name in features}
    return _Source(
        features=features,
        matches=verified_matches(path, names),
        extractor=extractors.pop(),
        extractor_options={},
        origin="its database",
    )


def _read_database_features(
    database: pycolmap.Database, image_id: int, image: pycolmap.Image
) -> tuple[Features, str]:
    keypoints = np.asarray(database.read_keypoints(image_id), np.float32)
    stored = database.read_descriptors(image_id)
    is_sift = stored.type in (pycolmap.FeatureExtractorType.SIFT, pycolmap.FeatureExtractorType.UNDEFINED)
    data = np.asarray(stored.data, np.uint8)
    camera = camera_of(image)
    features = Features(
        keypoints=np.ascontiguousarray(keypoints[:, :2]),
        descriptors=data if is_sift else data.view(np.float32),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(camera.width, camera.height),
        frames=_frames(keypoints) if is_sift else None,
    )
    return features, "sift" if is_sift else stored.type.name.lower().split("_")[0]


def _frames(keypoints: Float32[np.ndarray, "n columns"]) -> Float32[np.ndarray, "n 2"] | None:
    """Scales and orientations: the last two of four columns, or computed from the affine shapes of six."""
    if keypoints.shape[1] == 4:
        return keypoints[:, 2:]
    if keypoints.shape[1] < 6:
        return None
    shapes = keypoints[:, 2:].reshape(-1, 2, 2)
    scales = np.linalg.norm(shapes, axis=1).mean(axis=1)
    return np.stack([scales, np.arctan2(shapes[:, 1, 0], shapes[:, 0, 0])], axis=1)


def _from_hloc(model: pycolmap.Reconstruction, options: ImportOptions) -> _Source:
    path = options.features
    if path is None:
        raise ValueError("features must be given")
    stored = FeatureFile(path)
    features = {}
    for image in _posed_images(model):
        if image.name not in stored:
            raise ModelError(f"{path}: has no features of image {image.name!r} of the model")
        features[image.name] = stored[image.name]
    matches = {}
    if options.matches:
        raw = MatchFile(options.matches, sorted(features))
        _check_matches(options.matches, raw, features)
        matches = _consistent_matches(model, features, raw)
    return _Source(
        features=features,
        matches=matches,
        extractor=options.extractor,
        extractor_options={},
        origin="hloc's features",
    )


def _check_matches(path: Path, matches: MatchFile, features: Mapping[str, Features]) -> None:
    for a, b in matches:
        limits = (len(features[a]), len(features[b]))
        if np.any(matches[a, b] >= limits):
            raise ModelError(f"{path}: the matches of {a!r} and {b!r} refer to a missing keypoint")


def _consistent_matches(
    model: pycolmap.Reconstruction, features: Mapping[str, Features], raw: MatchFile
) -> dict[tuple[str, str], Int64[np.ndarray, "kept 2"]]:
    """Hloc's unverified matches, filtered by the epipolar geometry of the model's poses."""
    images = {image.name: image for image in _posed_images(model)}
    cameras = {name: camera_of(image) for name, image in images.items()}
    verified = {}
    for a, b in raw:
        pairs = raw[a, b]
        rays = [
            np.asarray(cameras[name].cam_from_img(features[name].keypoints[column].astype(np.float64)))
            for name, column in ((a, pairs[:, 0]), (b, pairs[:, 1]))
        ]
        b_from_a = images[b].cam_from_world() * images[a].cam_from_world().inverse()
        essential = pycolmap.essential_matrix_from_pose(b_from_a)
        squared = np.asarray(pycolmap.compute_squared_sampson_error(rays[0], rays[1], essential))
        focal = min(
            camera.mean_focal_length() / shrink_factor(_LONGEST_PX, camera.width, camera.height)
            for camera in (cameras[a], cameras[b])
        )
        good = pairs[squared * focal**2 < _MAX_EPIPOLAR_ERROR_PX**2]
        if len(good) >= _MIN_INLIERS:
            verified[a, b] = good
    return verified


def _from_images(
    model: pycolmap.Reconstruction, images: Path, orientation: Orientation, progress: ProgressBar
) -> _Source:
    if not images.is_dir():
        raise InputError(f"{images}: no such folder of images")
    features, extractor = redescribe(_posed_images(model), images, progress, orientation)
    return _Source(
        features=features,
        matches={},
        extractor=extractor.name,
        extractor_options=extractor.options,
        origin="its images",
    )


def _posed_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)


def _check_keypoints(model: pycolmap.Reconstruction, features: Mapping[str, Features]) -> None:
    for image in _posed_images(model):
        count, described = image.num_points2D(), len(features[image.name])
        if count != described:
            raise ModelError(
                f"image {image.name!r} has {count} keypoints in the model but {described} in the features: "
                "they belong to different runs"
            )
