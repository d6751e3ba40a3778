"""What a benchmark measured: objects, the maps that methods made of them, and trials on variants of these."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from slimsfm.evaluation.outcomes import Outcomes, join
from slimsfm.evaluation.protocol import Query
from slimsfm.geometry import Box


@dataclass(frozen=True, kw_only=True)
class MappedObject:
    """What a method made of an object's mapping sequence."""

    method: str
    """The method: an extractor, or extractor+matcher."""

    references: int
    """Reference images of the full map."""

    points: int
    """Points of the full map."""

    edges: int
    """Of the reference graph, at the threshold."""

    dominating_set: tuple[str, ...]
    """Names of its images."""

    lower_bound: int
    """No dominating set has fewer images."""

    dominating_points: int
    """Points that images of the dominating set see."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """All queries localized against one map."""

    references: int
    """Reference images of the map."""

    points: int
    """Points of the map."""

    map_bytes: int
    """Size of the map on disk."""

    outcomes: Outcomes
    """What became of the queries."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cell:
    """One strategy of one method on one variant of the map: a line of the table."""

    method: str
    """The method: an extractor, or extractor+matcher."""

    strategy: str
    """How queries were matched."""

    variant: str
    """Which map."""

    trials: tuple[Trial, ...]
    """One, or several where chance plays a part in the map."""

    @property
    def key(self) -> tuple[str, str, str]:
        """Method, strategy and variant."""
        return self.method, self.strategy, self.variant

    @cached_property
    def outcomes(self) -> Outcomes:
        """Of all trials, one after the other."""
        return join([trial.outcomes for trial in self.trials])


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectResult:
    """What was measured on one object."""

    name: str
    """The object."""

    box: Box
    """Its box, in the frame of the poses."""

    unit: str
    """Of that frame: "metre" or "unknown"."""

    images: Path
    """Folder of the mapping images; names in maps are relative to it."""

    queries: tuple[Query, ...]
    """The queries, in the order of all outcomes."""

    maps: tuple[MappedObject, ...]
    """One a method."""

    cells: tuple[Cell, ...]
    """Method by method, strategy by strategy."""

    def cell(self, method: str, strategy: str, variant: str) -> Cell | None:
        """The cell of this key, where it was measured."""
        return next((one for one in self.cells if one.key == (method, strategy, variant)), None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A benchmark: what is in its folder.

    FOLDER/results.json                           all of it
    FOLDER/table.md, table.tex, table.csv         the table
    FOLDER/queries.csv                            every query of every line
    FOLDER/objects/OBJECT.json                    an object that is done
    FOLDER/truth/OBJECT/                          the model that poses were taken from
    FOLDER/maps/OBJECT/METHOD/VARIANT             the maps: full, dominating, default; not random ones
    FOLDER/maps/OBJECT/METHOD/full/graph-*.npz    the reference graph
    """

    folder: Path
    """Where it lies."""

    dataset: str
    """What the data set is: its kind, and the name of its folder."""

    options: dict
    """What was asked for."""

    environment: dict[str, str]
    """Versions and machine."""

    objects: tuple[ObjectResult, ...]
    """Sorted by name."""

    failed: dict[str, str]
    """Objects that could not be measured, and why."""

    def map_path(self, name: str, method: str, variant: str) -> Path:
        """Where a map lies."""
        return map_path(self.folder, name, method, variant)


def map_path(folder: Path, name: str, method: str, variant: str) -> Path:
    """Where a run in a folder keeps a map."""
    return maps_path(folder, name) / method / variant.replace(":", "-")


def maps_path(folder: Path, name: str) -> Path:
    """Where a run in a folder keeps the maps of an object."""
    return folder / "maps" / name
