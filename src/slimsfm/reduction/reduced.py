"""The reduction of a map: choose what to keep, predict the loss, and create the reduced map."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from slimsfm.domination import Solution
from slimsfm.errors import InputError
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.graph import GraphOptions, ReferenceGraph
from slimsfm.graph.edge_sources import Edges
from slimsfm.graph.io import read_given_graph
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.info import SMALLEST_FIRST_SIZE
from slimsfm.mapping.io import weigh_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images, with_points
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction.choice import DOMINATING, Candidate, apply_choice
from slimsfm.reduction.disturbance import Conditions, check_conditions
from slimsfm.reduction.image_sets import (
    Cost,
    DominatingSetOptions,
    dominating_set,
    image_order,
    images_within,
    keep_random_images,
)
from slimsfm.reduction.limits import ReductionLimits, recommend
from slimsfm.reduction.pareto import (
    FrontierOptions,
    GraphProvider,
    check_reducible,
    find_graph,
    forecast_images,
    frontier,
)
from slimsfm.selection import REPLACED_SELECTORS, current_selector

Use = Literal["direct", "images", "both"]

_EXCLUSIVE = ("images", "random", "paper")
_NEED_SEVERAL = (
    "max_loss",
    "max_median_factor",
    "max_p90_factor",
    "max_error",
    "max_relative_error",
    "max_ms",
)
_SET_OPTIONS = ("solver", "dominators", "cost", "threshold")


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """How images are chosen; without any of these, several dominating sets are compared."""

    images: tuple[str, ...] = ()
    """Keep exactly these images."""

    random: int | None = None
    """Keep this number of images, drawn at random (the baseline of the paper)."""

    solver: str | None = None
    """Keep a dominating set found by this solver: exact, cpsat, greedy or random (the paper's)."""

    dominators: int | None = None
    """Number of kept images that localize each image that is not kept."""

    rim: bool = False
    """Keep images at the rim of the capture."""

    cost: Cost | None = None
    """What to minimize: the number of images, or the number of their observations."""

    threshold: float | None = None
    """Relative corner error below which an image counts as localized."""

    edges: Edges | None = None
    """How the reference graph is computed; `slimsfm graph --help` explains each way."""

    graph: Path | None = None
    """Errors of another system: .csv (reference, query, error), or .npz written by `slimsfm graph`."""

    paper: bool = False
    """Follow the paper: localize all pairs again, and keep the smallest of 1000 random dominating sets."""

    def __post_init__(self) -> None:
        self.set_options()  # raises on invalid values
        for name in _EXCLUSIVE:
            for other in self.given:
                if name in self.given and other != name:
                    raise InputError(f"{name} excludes all other ways to choose images, but {other} is given")
        if self.graph is not None and self.edges is not None:
            raise InputError("graph gives the reference graph, so edges cannot say how to compute it")

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the options that are set."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) != field.default)

    def set_options(self, *, seed: int = 0, max_images: int | None = None) -> DominatingSetOptions:
        """The options of the dominating set."""
        values = {name: getattr(self, name) for name in _SET_OPTIONS if getattr(self, name) is not None}
        if self.paper:
            values["solver"] = "random"
        return DominatingSetOptions(rim=self.rim, seed=seed, max_images=max_images, **values)

    @property
    def graph_options(self) -> GraphOptions:
        """The options of the reference graph."""
        if self.paper:
            return GraphOptions(edges="localize", candidates="all")
        return GraphOptions(edges=self.edges or "auto", threshold=self.set_options().threshold)


@dataclass(frozen=True, kw_only=True)
class ReduceOptions:
    """How to choose what is kept of a map.

    Raises:
        InputError: Two options contradict each other; both are named.
    """

    for_: Use | None = None
    """How queries are matched with the reduced map: with its points (direct), its images (images), or either
    (both). None: images if an option chooses images, else direct. With both, limits hold for each part."""

    selector: str | None = None
    """Selector of the points: information, kcover or random; None: information and kcover are compared."""

    limits: ReductionLimits = ReductionLimits()
    """Limits of the reduced map."""

    image_choice: ImageOptions = ImageOptions()
    """How images are chosen."""

    conditions: Conditions = "rough"
    """Queries that losses are predicted for: only some as clean as the map's photos (clean), or blurred and
    partly hidden ones too (rough), for which more points are kept where they need them."""

    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        check_conditions(self.conditions)
        if self.for_ is not None and self.for_ not in get_args(Use):
            raise ValueError(f"for_ must be one of {', '.join(get_args(Use))}, got {self.for_!r}")
        if self.selector is not None:
            current_selector(self.selector)
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        self._check_uses()
        self._check_limits()

    @property
    def uses(self) -> tuple[str, ...]:
        """What the reduced map is for: "direct", "images" or both."""
        if self.for_ == "both":
            return ("direct", "images")
        return (self.for_ or ("images" if self.image_choice.given else "direct"),)

    def _check_uses(self) -> None:
        given = self.image_choice.given
        if given and self.for_ == "direct":
            raise InputError(f"{given[0]} chooses images, but for direct keeps only points")
        if self.selector is not None and self.uses == ("images",):
            why = "for images" if self.for_ else given[0]
            raise InputError(f"selector chooses points, but {why} keeps only images; for both keeps both")

    def _check_limits(self) -> None:
        limits, image_choice = self.limits.given, self.image_choice
        if "max_images" in limits and self.uses == ("direct",):
            why = "for direct" if self.for_ else "without for images or for both, it"
            raise InputError(f"max_images limits images, but {why} keeps only points")
        if not image_choice.given:
            return
        first = image_choice.given[0]
        if image_choice.images or image_choice.random is not None:
            idle = [name for name in limits if name == "max_images" or self.uses == ("images",)]
            if idle:
                raise InputError(f"{first} leaves nothing to choose, so {idle[0]} cannot limit it")
            return
        for name in _NEED_SEVERAL:
            if name in limits:
                raise InputError(f"{name} needs several ways to choose images, but {first} leaves only one")
        try:
            image_choice.set_options(max_images=self.limits.max_images)
        except ValueError as error:
            raise InputError(str(error)) from error


@dataclass(frozen=True, kw_only=True, eq=False)
class Reduced:
    """A reduced map and what it keeps and costs."""

    map: Map
    """The reduced map."""

    forecast: Mapping[str, Candidate]
    """For each use, "direct" or "images", what is kept, its size, and how it is predicted to localize."""

    graph: ReferenceGraph | None = None
    """The reference graph, where a dominating set was requested."""

    solution: Solution | None = None
    """The dominating set that was requested; None where several were compared, or images were given."""

    notes: tuple[str, ...] = ()
    """Messages for the user, such as the replacement of a removed selector."""


def reduce(
    map: Map,
    options: ReduceOptions = ReduceOptions(),
    *,
    graph: ReferenceGraph | GraphProvider | None = None,
    progress: ProgressBar = silent,
) -> Reduced:
    """Make a map small, and predict what that costs.

    By default many selections of points are tried on the map's own images, each left out in turn, and the
    smallest one that loses nothing is kept, with a reserve that also holds for blurred and partly hidden
    queries. A map that was built without a detector has no points to match: a dominating set of its images is
    kept.

    Args:
        map: The full map.
        options: How to choose what is kept.
        graph: The reference graph, or a function that returns it; None: computed where it is needed.
        progress: Progress callback.

    Raises:
        InputError: Options contradict each other or the map, the map has fewer than two images, or no choice
            meets the limits; the nearest choice is named. Or what would be kept is predicted to localize no
            query.
        MapError: The map has no features.
    """
    check_reducible(map)
    options = _for_map(options, map)
    notes = tuple(
        f"selector {old} has been removed; {new} is used instead"
        for old, new in REPLACED_SELECTORS.items()
        if options.selector == old
    )
    reduced = Reduced(map=map, forecast={}, notes=notes)
    if options.image_choice.given:
        reduced = _with_images(reduced, options, graph, progress)
    left = tuple(use for use in options.uses if use not in reduced.forecast)
    if left:
        tried = FrontierOptions(uses=left, conditions=options.conditions, seed=options.seed)
        if options.selector:
            tried = replace(tried, selectors=(options.selector,))
        if options.limits.max_points:
            tried = replace(tried, budgets=(*tried.budgets, options.limits.max_points))
        found = frontier(map, tried, graph=graph, limits=options.limits, progress=progress)
        taken = {use: recommend(found, use, options.limits) for use in left}
        reduced = replace(reduced, forecast={**reduced.forecast, **taken})
    for use, one in reduced.forecast.items():
        _check_localizes(use, one)
    return replace(reduced, map=_with_first_image_size(_kept(map, reduced.forecast), reduced.forecast))


def _check_localizes(use: str, one: Candidate) -> None:
    tests = len(one.prediction.tests)
    if not tests or one.prediction.within(ADD_FRACTIONS[0]):
        return
    what_to_do = "keep more points or images"
    if not one.full.within(ADD_FRACTIONS[0]):
        what_to_do = "nor does the full map, so build or import it again"
    raise InputError(
        f"the reduced map for {use} would localize none of {tests} images left out; {what_to_do}"
    )


def _for_map(options: ReduceOptions, map: Map) -> ReduceOptions:
    """The options, with a dominating set for a map without points to match."""
    if map.has_keypoints:
        return options
    if options.for_ in ("direct", "both") or options.selector is not None:
        name = "selector" if options.for_ is None else f"for {options.for_}"
        raise InputError(f"{name} keeps points to match, but the map was built without a detector")
    given = options.image_choice.given
    return options if given else replace(options, image_choice=ImageOptions(solver="exact"))


def _with_images(
    reduced: Reduced,
    options: ReduceOptions,
    graph: ReferenceGraph | GraphProvider | None,
    progress: ProgressBar,
) -> Reduced:
    """Choose images as requested, and predict their effect."""
    full, wanted = reduced.map, options.image_choice
    predict = partial(forecast_images, full, conditions=options.conditions, progress=progress)
    if wanted.images:
        one = predict(wanted.images)
        return replace(reduced, forecast={"images": one})
    if wanted.random is not None:
        names = tuple(keep_random_images(full, wanted.random, seed=options.seed).images)
        detail = f"{len(names)} images, seed {options.seed}"
        one = predict(names, method="random", detail=detail)
        return replace(reduced, forecast={"images": one})
    given = read_given_graph(wanted.graph, full) if wanted.graph is not None else graph
    found = find_graph(full, wanted.graph_options, given, progress)
    asked = wanted.set_options(seed=options.seed, max_images=options.limits.max_images)
    solution = dominating_set(found, asked, full)
    names = _within(full, found, solution, asked, options.limits)
    one = predict(names, method=DOMINATING, detail=_detail(wanted, asked))
    return replace(reduced, forecast={"images": one}, graph=found, solution=solution)


def _detail(wanted: ImageOptions, asked: DominatingSetOptions) -> str:
    if wanted.paper:
        return "the paper's Algorithms 1 and 2: smallest of 1000 random sets on localized pairs"
    return f"{asked.solver}, k = {asked.dominators}" + (" and rim" if asked.rim else "")


def _within(
    map: Map,
    graph: ReferenceGraph,
    solution: Solution,
    asked: DominatingSetOptions,
    limits: ReductionLimits,
) -> tuple[str, ...]:
    """The dominating set, or the best images that meet the limits on points and bytes."""
    names = tuple(graph.names[i] for i in solution.chosen)

    def fits(some: tuple[str, ...]) -> bool:
        slim = keep_images(map, some)
        few = limits.max_points is None or len(slim.point3D_ids) <= limits.max_points
        return few and (limits.max_bytes is None or weigh_map(slim) <= limits.max_bytes)

    if not fits(names):
        order = image_order(graph, asked, map)
        names = images_within(order, fits)
        if not names:
            one = keep_images(map, order[:1])
            raise InputError(
                f"no set of images meets {limits}; the nearest, {order[0]} alone, has "
                f"{len(one.point3D_ids)} points and {weigh_map(one)} bytes"
            )
    return names


def _with_first_image_size(map: Map, forecast: Mapping[str, Candidate]) -> Map:
    """The map, knowing which image to extract the first features of queries from."""
    found = [one.sizes.best().size for one in forecast.values() if one.sizes]
    large = [size for size in found if size >= SMALLEST_FIRST_SIZE]
    return replace(map, info=replace(map.info, first_image_size=max(large, default=None)))


def _kept(map: Map, forecast: Mapping[str, Candidate]) -> Map:
    """The map that keeps what was chosen for one use or for both."""
    if len(forecast) == 1:
        (one,) = forecast.values()
        return apply_choice(map, one.choice)
    points = describe_points(map).of(forecast["direct"].choice.points)
    return with_points(apply_choice(map, forecast["images"].choice), map, points)
