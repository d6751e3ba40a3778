"""Outcomes of queries, how queries are localized and judged, and measurements per table row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from slimsfm.arrays import Points3D
from slimsfm.datasets.base import ObjectModel, PosedSequence
from slimsfm.features import Features
from slimsfm.files import inside
from slimsfm.geometry import Box, corner_error, rotation_error_deg, translation_error
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.localization.rounds import ExtractionChoice
from slimsfm.localization.strategy import MatchingOptions
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import ModelQuality
from slimsfm.photos import Orientation, read_image, read_photo
from slimsfm.progress import ProgressBar, silent
from slimsfm.skipping import SkippedPhotos

STAGES = ("extract", "match", "pose")
"""Stages of localizing a query, in this order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedQuery:
    """A query image with a known pose."""

    path: Path
    """The image file."""

    camera: pycolmap.Camera
    """Its intrinsics."""

    cam_from_world: pycolmap.Rigid3d
    """Its true pose in the frame of the map."""

    orientation: Orientation = "upright"
    """Which pixels of the file camera and pose are of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """Results of localizing n queries; entry i of each field belongs to query i."""

    error: Float64[np.ndarray, " n"]
    """Error relative to the size of the object, see `PoseError.relative`; infinite without a pose."""

    rotation_deg: Float64[np.ndarray, " n"]
    """Rotation error; infinite without a pose."""

    translation: Float64[np.ndarray, " n"]
    """Translation error in map units; infinite without a pose."""

    confidence: Float64[np.ndarray, " n"]
    """Probability that the pose is correct; NaN without a pose."""

    references: Int64[np.ndarray, " n"]
    """Number of reference images that the query was matched with."""

    seconds: Float64[np.ndarray, "n 3"]
    """Time of each of `STAGES`."""

    cam_from_world: tuple[pycolmap.Rigid3d | None, ...]
    """The estimated poses."""

    def __post_init__(self) -> None:
        lengths = {name: len(values) for name, values in vars(self).items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"all fields must have the same number of queries, got {lengths}")

    def __len__(self) -> int:
        return len(self.error)


def join_outcomes(parts: Sequence[Outcomes]) -> Outcomes:
    """Concatenate outcomes."""
    return Outcomes(
        error=np.concatenate([one.error for one in parts]),
        rotation_deg=np.concatenate([one.rotation_deg for one in parts]),
        translation=np.concatenate([one.translation for one in parts]),
        confidence=np.concatenate([one.confidence for one in parts]),
        references=np.concatenate([one.references for one in parts]),
        seconds=np.concatenate([one.seconds for one in parts]),
        cam_from_world=tuple(pose for one in parts for pose in one.cam_from_world),
    )


@dataclass(frozen=True, kw_only=True)
class MappedObject:
    """The full map of an object with one method, and its dominating set."""

    method: str
    """Name of the method: EXTRACTOR or EXTRACTOR+MATCHER."""

    references: int
    """Number of reference images in the full map."""

    points: int
    """Number of points in the full map."""

    edges: int
    """Number of edges of the reference graph at the threshold."""

    dominating_set: tuple[str, ...]
    """Names of the images in the dominating set."""

    lower_bound: int
    """Every dominating set has at least this many images."""

    dominating_points: int
    """Number of points that the images of the dominating set observe."""

    quality: ModelQuality | None = None
    """What supports the map, and what contradicts it; None if that was not measured."""

    notes: tuple[str, ...] = ()
    """What was skipped, ignored or guessed when the map was made."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapRun:
    """All queries localized against one map."""

    references: int
    """Number of reference images in the map."""

    points: int
    """Number of points in the map."""

    map_bytes: int
    """Size of the map on disk."""

    outcomes: Outcomes
    """Outcomes of the queries."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """One method and strategy on one variant of the map: a row of the table."""

    method: str
    """Name of the method: EXTRACTOR or EXTRACTOR+MATCHER."""

    strategy: str
    """How queries are matched."""

    variant: str
    """Variant of the map, as spelled in the options."""

    map_runs: tuple[MapRun, ...]
    """One run, or one per draw for random variants."""

    @property
    def key(self) -> tuple[str, str, str]:
        """Method, strategy and variant."""
        return self.method, self.strategy, self.variant

    @cached_property
    def outcomes(self) -> Outcomes:
        """Outcomes of all runs, concatenated."""
        return join_outcomes([run.outcomes for run in self.map_runs])


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectResult:
    """All measurements of one object."""

    name: str
    """Name of the object."""

    box: Box
    """Box of the object, in the frame of the poses."""

    unit: str
    """Unit of that frame: "metre" or "unknown"."""

    images: Path
    """Folder of the mapping images; image names in maps are relative to it."""

    queries: tuple[PosedQuery, ...]
    """The queries, in the order of all outcomes."""

    maps: tuple[MappedObject, ...]
    """One per method."""

    measurements: tuple[Measurement, ...]
    """Sorted by method, then by strategy, in the order of the options."""

    skipped: Mapping[str, str] = field(default_factory=dict)
    """Why queries were not measured, by path: they cannot be read."""

    contradicted: Mapping[str, str] = field(default_factory=dict)
    """What contradicts the true pose of each query or mapping image that was left out, by name."""

    def measurement(self, method: str, strategy: str, variant: str) -> Measurement | None:
        """The measurement with this key, or None if it does not exist."""
        return next((one for one in self.measurements if one.key == (method, strategy, variant)), None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """The results of a benchmark, stored in a folder.

    FOLDER/results.json                           all results
    FOLDER/table.md, table.tex, table.csv         the table
    FOLDER/queries.csv                            every query of every row
    FOLDER/objects/OBJECT.json                    results of a finished object
    FOLDER/truth/OBJECT/                          the model that provides the true poses
    FOLDER/maps/OBJECT/METHOD/VARIANT             the maps, except random ones
    FOLDER/maps/OBJECT/METHOD/full/graph-*.npz    the reference graph
    """

    folder: Path
    """Folder of the run."""

    dataset: str
    """Kind of the data set and name of its folder."""

    options: dict
    """Options of the benchmark as plain values."""

    environment: dict[str, str]
    """Software versions and the machine."""

    objects: tuple[ObjectResult, ...]
    """Results of all objects, sorted by name."""

    failed: dict[str, str]
    """Error message of each object that could not be measured."""

    def map_path(self, name: str, method: str, variant: str) -> Path:
        """Folder of one map."""
        return map_path(self.folder, name, method, variant)


def map_path(folder: Path, name: str, method: str, variant: str) -> Path:
    """Folder of one map of an object, inside the folder of a run."""
    return inside(maps_path(folder, name) / method, variant.replace(":", "-"))


def maps_path(folder: Path, name: str) -> Path:
    """Folder of all maps of an object, inside the folder of a run."""
    return inside(folder / "maps", name)


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """Difference between an estimated and the true pose; infinite without a pose."""

    relative: float
    """Mean distance of the corners of the box under the two poses, divided by its diagonal. If the data set
    has a model of the object: mean distance of its vertices, divided by its diameter."""

    rotation_deg: float
    """Angle between the two rotations, in [0, 180]."""

    translation: float
    """Distance between the two positions of the world origin in the camera frame, in map units."""


NO_POSE = PoseError(relative=np.inf, rotation_deg=np.inf, translation=np.inf)
"""Error of a query without a pose."""


def pose_error(
    estimated_cam_from_world: pycolmap.Rigid3d | None,
    true_cam_from_world: pycolmap.Rigid3d,
    box: Box,
    model: ObjectModel | None = None,
) -> PoseError:
    """Compare an estimated pose with the true pose.

    Args:
        estimated_cam_from_world: The estimate, or None if there is no pose.
        true_cam_from_world: The true pose.
        box: Box of the object. Its corners define the error, as in the paper.
        model: Model of the object, if the data set has one. Its vertices then define the error [1]; for a
            symmetric object, each vertex counts with its distance to the nearest one.

    References:
        [1] Hinterstoisser et al., Model Based Training, Detection and Pose Estimation of Texture-less 3D
            Objects in Heavily Cluttered Scenes, ACCV 2012: ADD, and ADD-S for symmetric objects.
    """
    if estimated_cam_from_world is None:
        return NO_POSE
    if model is None:
        relative = corner_error(estimated_cam_from_world, true_cam_from_world, box)
    else:
        relative = model_error(estimated_cam_from_world, true_cam_from_world, model)
    return PoseError(
        relative=relative,
        rotation_deg=rotation_error_deg(estimated_cam_from_world, true_cam_from_world),
        translation=translation_error(estimated_cam_from_world, true_cam_from_world),
    )


def model_error(
    estimated_cam_from_world: pycolmap.Rigid3d, true_cam_from_world: pycolmap.Rigid3d, model: ObjectModel
) -> float:
    """ADD, or ADD-S if the object is symmetric: mean distance of the vertices, divided by the diameter."""
    estimated, true = (pose * model.vertices for pose in (estimated_cam_from_world, true_cam_from_world))
    return float(_distances(estimated, true, nearest=model.symmetric).mean() / model.diameter)


def _distances(estimated: Points3D, true: Points3D, *, nearest: bool) -> Float64[np.ndarray, " n"]:
    """From each true vertex to the estimated one, or to the nearest estimated one."""
    if nearest:
        return np.asarray(KDTree(estimated).query(true)[0], np.float64)
    return np.linalg.norm(estimated - true, axis=1)


def outcomes_of(
    found: Sequence[Localization],
    truth: Sequence[pycolmap.Rigid3d],
    box: Box,
    model: ObjectModel | None = None,
) -> Outcomes:
    """Compare localization results with the true poses.

    Args:
        found: Localization result of each query.
        truth: True pose of each query.
        box: Box of the object.
        model: Model of the object, if the data set has one.

    Raises:
        ValueError: `found` is empty, or `found` and `truth` differ in length.
    """
    if not found:
        raise ValueError("found must hold at least one query")
    poses = tuple(one.pose and one.pose.cam_from_world for one in found)
    errors = [pose_error(pose, true, box, model) for pose, true in zip(poses, truth, strict=True)]
    confidence = [one.pose.confidence if one.pose else None for one in found]
    return Outcomes(
        error=np.array([one.relative for one in errors]),
        rotation_deg=np.array([one.rotation_deg for one in errors]),
        translation=np.array([one.translation for one in errors]),
        confidence=np.array([np.nan if one is None else one for one in confidence], np.float64),
        references=np.array([one.references for one in found], np.int64),
        seconds=np.array([[getattr(one.seconds, stage) for stage in STAGES] for one in found], np.float64),
        cam_from_world=poses,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedQuery:
    """A query with extracted features, which all variants and strategies share."""

    query: PosedQuery
    """The image and its true pose."""

    features: Features
    """Features from the extractor of the map."""

    extract_seconds: float
    """Extraction time."""


def queries_of(sequence: PosedSequence) -> list[PosedQuery]:
    """The frames of a sequence as queries."""
    return [
        PosedQuery(path=path, camera=camera, cam_from_world=pose, orientation=sequence.orientation)
        for path, camera, pose in zip(
            sequence.image_paths, sequence.cameras, sequence.cam_from_world, strict=True
        )
    ]


def readable_queries(
    queries: Sequence[PosedQuery], folder: Path
) -> tuple[list[PosedQuery], Mapping[str, str]]:
    """The queries that can be read, and why others cannot, by path.

    Raises:
        ImageError: No query can be read.
    """
    skipped = SkippedPhotos(folder)
    for query in queries:
        with skipped.skipping(str(query.path)):
            read_photo(query.path, query.orientation, warn=False)
    left = set(skipped.left(str(query.path) for query in queries))
    return [query for query in queries if str(query.path) in left], skipped.reasons


def prepare_queries(
    map: Map, queries: Sequence[PosedQuery], progress: ProgressBar = silent
) -> list[PreparedQuery]:
    """Extract the features of queries with the extractor of the map."""
    extractor = extractor_of(map)
    prepared = []
    for query in progress(queries, "extract query features"):
        photo = read_photo(query.path, query.orientation)
        start = perf_counter()
        features = extractor.extract(photo.image, photo.visible)
        seconds = perf_counter() - start
        prepared.append(PreparedQuery(query=query, features=features, extract_seconds=seconds))
    return prepared


def localize_all(
    map: Map,
    queries: Sequence[PreparedQuery],
    strategy: str,
    matcher: str = "auto",
    progress: ProgressBar = silent,
    extraction: ExtractionChoice = "whole",
) -> list[Localization]:
    """Localize queries one after the other.

    The first query runs once more before, without timing, to fill caches. With extraction in rounds, the
    images are read again, because which features are extracted depends on the map.

    Raises:
        ValueError: `queries` is empty.
    """
    if not queries:
        raise ValueError("queries must hold at least one query")
    options = LocalizationOptions(
        strategy=strategy, matching=MatchingOptions(matcher=matcher), extraction=extraction
    )
    localizer = Localizer(map, options)
    _localize(localizer, queries[0])
    return [_localize(localizer, query) for query in progress(queries, f"localize queries ({strategy})")]


def evaluate(
    map: Map,
    queries: Sequence[PreparedQuery],
    strategy: str,
    matcher: str = "auto",
    progress: ProgressBar = silent,
    model: ObjectModel | None = None,
    extraction: ExtractionChoice = "whole",
) -> Outcomes:
    """Localize queries against a map and compare the poses with the true ones.

    Args:
        map: The map.
        queries: The queries with their features.
        strategy: How queries are matched.
        matcher: Name of the matcher.
        progress: Progress callback, called once per query.
        model: Model of the object, if the data set has one.
        extraction: Image that features are extracted from; whole takes those that are prepared.
    """
    found = localize_all(map, queries, strategy, matcher, progress, extraction)
    return outcomes_of(found, [one.query.cam_from_world for one in queries], map.box, model)


def _localize(localizer: Localizer, prepared: PreparedQuery) -> Localization:
    query = prepared.query
    if localizer.options.extraction == "rounds":
        photo = read_photo(query.path, query.orientation, warn=False)
        return localizer.localize(photo.image, query.camera, mask=photo.visible)
    image = read_image(query.path, query.orientation) if localizer.looks_at_images else None
    found = localizer.localize_features(prepared.features, query.camera, image=image)
    return replace(found, seconds=replace(found.seconds, extract=prepared.extract_seconds))
