"""What a benchmark measures: outcomes of queries, maps of each object, one measurement per table row."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.geometry import Box

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
    return maps_path(folder, name) / method / variant.replace(":", "-")


def maps_path(folder: Path, name: str) -> Path:
    """Folder of all maps of an object, inside the folder of a run."""
    return folder / "maps" / name
