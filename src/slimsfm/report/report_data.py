"""What the report shows of a run: rows and comparisons, and maps and reference graphs of its objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from slimsfm.errors import InputError
from slimsfm.evaluation.benchmark import BenchmarkOptions, graph_options, parse_method
from slimsfm.evaluation.comparison import Comparison, MeasurementKey, against_full
from slimsfm.evaluation.results import MappedObject, ObjectResult, Run
from slimsfm.evaluation.table import BY_FRAME, BY_OBJECT, Row, average_rows, rows_of
from slimsfm.evaluation.variants import parse_variant
from slimsfm.files import contents_of
from slimsfm.graph import ReferenceGraph
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.reduction import DominatingSetOptions

_AGAIN = "run the benchmark again"
_HEADLINES = ("default", "dominating")
_FULL_OBJECTS = 6  # with more objects, each gets a share of the limits
_PHOTO_BYTES = 600_000  # all photos of one reference graph
_BYTES_PER_PX = 0.5  # base64 text of a small JPEG
_MAX_PHOTO_PX, _MIN_PHOTO_PX = 160, 40


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportData:
    """A run and the values computed from it."""

    run: Run
    """The results of a benchmark."""

    rows: dict[str, list[Row]]
    """Rows of the results table by object, and by average if there are several objects."""

    comparisons: list[Comparison]
    """Every line compared with the full map, for each object and for all of them."""

    @property
    def overall(self) -> str:
        """Key of the rows and comparisons of the whole run."""
        names = [one.name for one in self.run.objects]
        return BY_FRAME if len(names) > 1 else names[0]

    @property
    def methods(self) -> list[str]:
        """Names of the methods in the run."""
        return list(dict.fromkeys(cell.method for one in self.run.objects for cell in one.measurements))

    def headlines(self, name: str) -> list[Comparison]:
        """The comparisons in the headline of an object: `slimsfm reduce`'s default, and the dominating set.

        Falls back to another line if neither was measured; empty if only the full map was.
        """
        found = [one for one in self.comparisons if one.object == name]
        firsts = [next((one for one in found if one.after[2] == kind), None) for kind in _HEADLINES]
        return [one for one in firsts if one] or found[:1]

    def row(self, name: str, key: MeasurementKey) -> Row:
        """The row of a line of an object."""
        return next(row for row in self.rows[name] if (row.method, row.strategy, row.variant) == key)


def load_report_data(run: Run) -> ReportData:
    """Compute the rows and comparisons of a run.

    Raises:
        ValueError: The run has no object.
    """
    if not run.objects:
        raise ValueError("run must hold at least one object")
    rows = {one.name: rows_of(one) for one in run.objects}
    return ReportData(run=run, rows=rows | _averages(run.objects), comparisons=against_full(run.objects))


def _averages(objects: Sequence[ObjectResult]) -> dict[str, list[Row]]:
    rows = average_rows(objects)
    names = (BY_FRAME, BY_OBJECT) if rows else ()
    return {name: [row for row in rows if row.object == name] for name in names}


@dataclass(frozen=True, kw_only=True, eq=False)
class RunMaps:
    """The maps and the reference graph of one object and method."""

    result: ObjectResult
    """Results of the object."""

    mapped: MappedObject
    """Statistics of the method's maps."""

    maps: dict[str, Map]
    """Maps by variant, the full one first; a run does not keep random variants."""

    graph: ReferenceGraph
    """Reference graph of the full map."""

    threshold: float
    """Largest relative corner error of the graph's edges."""


def load_run_maps(run: Run, result: ObjectResult, method: str) -> RunMaps:
    """Read the maps and the reference graph of an object.

    Raises:
        MapError: A map is missing or damaged.
        InputError: The results are not those of these maps.
    """
    with contents_of(run.folder / "results.json", "damaged", _AGAIN):
        variants = [cell.variant for cell in result.measurements if cell.method == method]
        kept = [one for one in dict.fromkeys(("full", *variants)) if not parse_variant(one).is_random]
        mapped = next(one for one in result.maps if one.method == method)
        threshold = run.options["reduction"]["threshold"]
        # all options that the graph depends on
        reduction = DominatingSetOptions(threshold=threshold)
        asked = BenchmarkOptions(edges=run.options["edges"], reduction=reduction)
        options = graph_options(asked, parse_method(method))
    maps = {variant: read_map(run.map_path(result.name, method, variant)) for variant in kept}
    if unknown := set(mapped.dominating_set).difference(maps["full"].images):
        raise InputError(f"{run.folder}: {min(unknown)!r} of {result.name} is not in its map; {_AGAIN}")
    return RunMaps(
        result=result,
        mapped=mapped,
        maps=maps,
        graph=load_or_compute_graph(maps["full"], run.map_path(result.name, method, "full"), options).graph,
        threshold=threshold,
    )


@dataclass(frozen=True, kw_only=True)
class ReportBudget:
    """Limits for one object, so that a page about many objects still opens."""

    points: int
    """3D points per map."""

    frames: int
    """Number of query images."""

    frame_px: int
    """Longer side of a query image."""

    photo_px: int
    """Longer side of a reference photo; 0 shows only photos of the dominating set, at the smallest size."""


def report_budget(objects: int, references: int) -> ReportBudget:
    """The limits for each of several objects with this many reference images."""
    share = min(1.0, _FULL_OBJECTS / objects)
    pixels = share * _PHOTO_BYTES / (references * _BYTES_PER_PX)
    side = round(sqrt(pixels * 4 / 3))
    return ReportBudget(
        points=max(1000, round(15_000 * share)),
        frames=max(2, round(6 * share)),
        frame_px=max(240, round(480 * sqrt(share))),
        photo_px=min(_MAX_PHOTO_PX, side) if side >= _MIN_PHOTO_PX else 0,
    )
