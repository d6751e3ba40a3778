"""Strategies times variants of one map: the paper's comparison."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slimsfm.domination import Solution
from slimsfm.evaluation.protocol import Label, PreparedQuery, evaluate
from slimsfm.evaluation.table import Row, mean_row
from slimsfm.evaluation.variants import VARIANTS, Making
from slimsfm.graph import ReferenceGraph
from slimsfm.localization import STRATEGIES
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction import ReductionOptions, Weigh, dominating_set

StoredMap = tuple[Map, int]
"""A map as read from disk, and its size there in bytes."""

Store = Callable[[Map, str], StoredMap]
"""Writes a map under a name."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What is compared."""

    strategies: tuple[str, ...] = ("exhaustive", "retrieval", "progressive", "direct")
    """How queries are matched."""

    matcher: str = "auto"
    """What matches images, when mapping as when localizing; auto: what suits the features."""

    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which maps they are matched against: all of it, a dominating set of images, what `slimsfm reduce` gives
    by itself, and as many images as in the dominating set drawn at random."""

    reduction: ReductionOptions = ReductionOptions()
    """How the dominating set is chosen."""

    def __post_init__(self) -> None:
        _check_names("strategies", self.strategies, STRATEGIES)
        _check_names("variants", self.variants, VARIANTS)


def _check_names(argument: str, values: Sequence[str], known: dict) -> None:
    if not values or not known.keys() >= set(values):
        raise ValueError(f"{argument} must be among {', '.join(known)}, got {', '.join(values) or 'none'}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Benchmark:
    """What a benchmark of one map gave."""

    rows: tuple[Row, ...]
    """One a strategy and variant, strategy by strategy."""

    solution: Solution
    """The dominating set, by index into the sorted names of the map's images."""


def benchmark(
    map: Map,
    graph: ReferenceGraph,
    queries: Sequence[PreparedQuery],
    *,
    name: str,
    store: Store,
    weigh: Weigh,
    options: BenchmarkOptions = BenchmarkOptions(),
    progress: ProgressBar = silent,
) -> Benchmark:
    """Localize the same queries with every strategy against every variant of a map.

    The row of a variant in which chance plays a part is the mean over five draws. A map for direct matching
    alone has no row for other strategies.
    """
    solution = dominating_set(graph, options.reduction, map)
    making = Making(map=map, solution=solution, weigh=weigh, progress=progress)
    stored = {
        variant: [store(one, f"{variant}-{draw}") for draw, one in enumerate(VARIANTS[variant](making))]
        for variant in options.variants
    }
    rows = []
    for strategy in options.strategies:
        for variant, maps in stored.items():
            if strategy != "direct" and any(one.is_for_direct_matching for one, _ in maps):
                continue
            labelled = Label(object=name, strategy=strategy, matcher=options.matcher, variant=variant)
            draws = [
                evaluate(one, queries, labelled, map_bytes=size, progress=progress) for one, size in maps
            ]
            rows.append(mean_row(draws))
    return Benchmark(rows=tuple(rows), solution=solution)
