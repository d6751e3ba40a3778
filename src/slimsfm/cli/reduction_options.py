"""Options of `slimsfm reduce`."""

from dataclasses import dataclass
from pathlib import Path

from slimsfm.cli.execution import Execution, resumable
from slimsfm.cli.units import parse_bytes, parse_percent
from slimsfm.graph import GraphOptions, ReferenceGraph
from slimsfm.graph.io import graph_of, read_given_graph
from slimsfm.graph.source import Edges
from slimsfm.mapping.map import Map
from slimsfm.progress import shown
from slimsfm.reduction import ReductionOptions, Wish
from slimsfm.reduction.images import Cost


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the slim map must keep to; the smallest that does is taken."""

    max_loss: str | None = None
    """Percentage points that may be lost against the full map, such as 1%; nothing, with a reserve, if not
    given."""

    max_bytes: str | None = None
    """Size on disk, such as 100kB."""

    max_ms: float | None = None
    """Time of matching and pose a query, on this machine."""

    max_points: int | None = None
    """Number of points."""

    max_images: int | None = None
    """Number of images, where images are kept."""

    def __post_init__(self) -> None:
        _ = self.wish  # refuses what it cannot read

    @property
    def wish(self) -> Wish:
        """The same in plain numbers."""
        return Wish(
            max_loss=None if self.max_loss is None else parse_percent(self.max_loss, "max-loss"),
            max_bytes=None if self.max_bytes is None else parse_bytes(self.max_bytes, "max-bytes"),
            max_ms=self.max_ms,
            max_points=self.max_points,
            max_images=self.max_images,
        )


@dataclass(frozen=True, kw_only=True)
class ByImages:
    """Keep a dominating set of the images; given one of these, nothing is compared."""

    solver: str | None = None
    """Who chooses: exact, cpsat, greedy or random (the paper's)."""

    dominators: int | None = None
    """How many kept images localize each one that is not kept."""

    rim: bool = False
    """Keep the rim of the capture."""

    cost: Cost | None = None
    """What is to be least: the number of images, or that of their observations."""

    threshold: float | None = None
    """Largest relative corner error of a pose for which an image counts as localized."""

    edges: Edges | None = None
    """How the reference graph is computed; `slimsfm graph --help` explains each way."""

    graph: Path | None = None
    """Errors of another system instead: .csv (reference, query, error) or .npz as of `slimsfm graph`."""

    paper: bool = False
    """Exactly the paper's procedure: all pairs localized anew, smallest of 1000 random sets."""

    def __post_init__(self) -> None:
        _ = self.options(0)  # refuses what cannot be
        if self.paper and self != ByImages(paper=True):
            raise ValueError("paper excludes all other ways to choose images")

    @property
    def is_wanted(self) -> bool:
        """Whether anything was given."""
        return self != ByImages()

    def options(self, seed: int) -> ReductionOptions:
        """The options of the choice."""
        given = {name: getattr(self, name) for name in ("solver", "dominators", "cost", "threshold")}
        given = {name: value for name, value in given.items() if value is not None}
        if self.paper:
            given["solver"] = "random"
        return ReductionOptions(rim=self.rim, seed=seed, **given)

    def graph_of(self, full: Map, path: Path, execution: Execution) -> ReferenceGraph:
        """The reference graph to choose by."""
        if self.graph:
            return read_given_graph(self.graph, full)
        edges = GraphOptions(edges=self.edges or "auto", threshold=self.options(0).threshold)
        if self.paper:
            edges = GraphOptions(edges="localize", candidates="all")
        with resumable():
            return graph_of(full, path, edges, execution.open_executor(), shown).graph
