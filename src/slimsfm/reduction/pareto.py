"""The frontier of a map: what many ways to reduce it keep and lose, predicted on the map's own references."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slimsfm.errors import InputError, MapError
from slimsfm.graph import GraphOptions, ReferenceGraph, compute_graph
from slimsfm.graph.edge_sources import Edges
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.io import weigh_map
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction.choice import (
    DOMINATING,
    Candidate,
    Choice,
    Frontier,
    apply_choice,
    points_seen,
)
from slimsfm.reduction.disturbance import Conditions, check_conditions
from slimsfm.reduction.extraction_time import extraction_if_known, extraction_seconds
from slimsfm.reduction.forecast import Prediction, Trials
from slimsfm.reduction.image_sets import DominatingSetOptions, dominating_set
from slimsfm.reduction.limits import ReductionLimits, check_reachable
from slimsfm.selection import REPLACED_SELECTORS, SELECTORS, current_selector
from slimsfm.selection.problem import SelectionProblem
from slimsfm.selection.usable_points import LeftOut, selection_problem

USES = ("direct", "images")
"""How queries can be matched with a reduced map: with its points directly, or with its images."""

GraphProvider = Callable[[Map, GraphOptions], ReferenceGraph]
"""Returns the reference graph of a map for some options, such as one that is kept on disk."""


@dataclass(frozen=True, kw_only=True)
class FrontierOptions:
    """Which ways to reduce a map are compared."""

    uses: tuple[str, ...] = USES
    """How queries are matched with the reduced map: direct, images or both."""

    selectors: tuple[str, ...] = ("information", "kcover")
    """Selectors of points."""

    budgets: tuple[int, ...] = (100, 150, 200, 300, 400, 600, 800, 1200, 1600, 2400, 3200)
    """Numbers of points to keep."""

    dominators: tuple[int, ...] = (1, 2, 3)
    """Numbers of kept images that localize each other image, where images are kept."""

    rim: tuple[bool, ...] = (False, True)
    """Whether the rim of the capture is kept, where images are kept."""

    edges: Edges = "auto"
    """How the reference graph is computed, where images are kept; see `GraphOptions.edges`."""

    conditions: Conditions = "rough"
    """Queries to predict: only some as clean as the map's photos, or blurred and partly hidden ones too."""

    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        check_conditions(self.conditions)
        selectors = (*SELECTORS, *(name for name in REPLACED_SELECTORS if name in self.selectors))
        for name, known in (("uses", USES), ("selectors", selectors)):
            values = getattr(self, name)
            if not values or not set(values) <= set(known):
                raise ValueError(
                    f"{name} must be among {', '.join(known)}, got {', '.join(values) or 'none'}"
                )
        for name in ("budgets", "dominators"):
            if not getattr(self, name) or min(getattr(self, name)) < 1:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


def frontier(
    map: Map,
    options: FrontierOptions = FrontierOptions(),
    *,
    graph: ReferenceGraph | GraphProvider | None = None,
    limits: ReductionLimits = ReductionLimits(),
    progress: ProgressBar = silent,
) -> Frontier:
    """Try many ways to reduce a map, and predict on its own references what each of them loses.

    Args:
        map: The full map.
        options: What to try.
        graph: The reference graph, or a function that returns it; None: computed where images are chosen.
        limits: Limits that some choice for each use must be able to meet.
        progress: Progress callback.

    Raises:
        InputError: The map has fewer than two images, or no choice can meet the limits on bytes, points and
            images; the nearest choice is named, and nothing has been predicted yet.
        MapError: The map has no features, or was built without a detector.
        SlimsfmError: `limits` has a time, but the map's extractor cannot be loaded.
    """
    check_reducible(map)
    if not map.has_keypoints:
        raise MapError(
            "the map was built without a detector: losses cannot be predicted from its features; "
            "reduce it for images by a solver, such as exact"
        )
    left_out = LeftOut(map)
    problem = selection_problem(map, left_out, progress) if "direct" in options.uses else None
    edges = GraphOptions(edges=options.edges)
    needed = find_graph(map, edges, graph, progress) if "images" in options.uses else None
    choices = list(_choices(map, needed, problem, options))
    described = describe_points(map) if "direct" in options.uses else None
    sizes = [
        weigh_map(apply_choice(map, choice, described=described))
        for choice in progress(choices, "measure sizes")
    ]
    for use in options.uses:
        check_reachable(choices, sizes, use, limits)
    if limits.max_ms is not None:
        extraction_seconds(map)  # an extractor that is missing is an error now
    extract_seconds = partial(extraction_if_known, map)
    trials = Trials(map, left_out, conditions=options.conditions, extract_seconds=extract_seconds)
    full, candidates = _predicted(trials, choices, sizes, progress)
    return Frontier(full=full, candidates=candidates, bytes=weigh_map(map), diagonal=map.box.diagonal)


def _predicted(
    trials: Trials, choices: list[Choice], sizes: list[int], progress: ProgressBar
) -> tuple[Prediction, tuple[Candidate, ...]]:
    full = trials.full(trials.tests, progress)
    candidates = []
    for choice, size in zip(progress(choices, "predict losses"), sizes, strict=True):
        if choice.use == "images":
            prediction, targets = trials.images(choice.images), trials.image_targets(choice.images)
        else:
            prediction, targets = trials.points(choice.points), trials.point_targets(choice.points)
        tried = trials.sizes(targets)
        candidates.append(
            Candidate(
                choice=choice,
                bytes=size,
                prediction=prediction.in_rounds(tried),
                full=full.of(prediction.tests),
                sizes=tried,
            )
        )
    return full, tuple(candidates)


def check_reducible(map: Map) -> None:
    """Check that there is something to choose.

    Raises:
        InputError: The map has fewer than two images.
        MapError: The map has no features.
    """
    check_has_features(map)
    if len(map.images) < 2:
        raise InputError("the map has one image; there is nothing to reduce")


def find_graph(
    map: Map, options: GraphOptions, graph: ReferenceGraph | GraphProvider | None, progress: ProgressBar
) -> ReferenceGraph:
    """Return the reference graph that was given, or compute it."""
    if isinstance(graph, ReferenceGraph):
        return graph
    return compute_graph(map, options, progress=progress).graph if graph is None else graph(map, options)


def forecast_images(
    map: Map,
    names: Iterable[str],
    *,
    method: str = "images",
    detail: str | None = None,
    conditions: Conditions = "rough",
    progress: ProgressBar = silent,
) -> Candidate:
    """Predict the effect of keeping these images; the other images are the tests.

    Args:
        map: The full map.
        names: The images to keep.
        method: How they were chosen.
        detail: The request to the method; None: the names.
        conditions: Queries to predict.
        progress: Progress callback.

    Raises:
        InputError: A name is not that of a reference image, or no name is given.
    """
    images = tuple(sorted(set(names)))
    slim = keep_images(map, images)
    trials = Trials(
        map, LeftOut(map), conditions=conditions, extract_seconds=partial(extraction_if_known, map)
    )
    choice = Choice(
        use="images",
        method=method,
        detail=", ".join(images) if detail is None else detail,
        images=images,
        points=points_seen(map, images),
    )
    prediction, tried = trials.images(images), trials.sizes(trials.image_targets(images))
    return Candidate(
        choice=choice,
        bytes=weigh_map(slim),
        prediction=prediction.in_rounds(tried),
        full=trials.full(prediction.tests, progress),
        sizes=tried,
    )


def _choices(
    map: Map, graph: ReferenceGraph | None, problem: SelectionProblem | None, options: FrontierOptions
) -> Iterator[Choice]:
    if problem is not None:
        for selector in options.selectors:
            yield from _point_choices(problem, selector, options)
    for images, detail in _image_sets(map, graph, options) if graph else ():
        points = points_seen(map, images)
        for use in options.uses:
            kept = images if use == "images" else ()
            yield Choice(use=use, method=DOMINATING, detail=detail, images=kept, points=points)


def _point_choices(problem: SelectionProblem, selector: str, options: FrontierOptions) -> Iterator[Choice]:
    method = current_selector(selector)
    for budget in sorted(set(options.budgets)):
        points = np.sort(SELECTORS[method](problem, budget, seed=options.seed))
        if len(points):
            yield Choice(
                use="direct", method=method, detail=f"{len(points)} points", images=(), points=points
            )
        if len(points) < budget:
            return  # there are no more


def _image_sets(
    map: Map, graph: ReferenceGraph, options: FrontierOptions
) -> Iterator[tuple[tuple[str, ...], str]]:
    known = set()
    plain = DominatingSetOptions(seed=options.seed)
    for rim in options.rim:
        for dominators in options.dominators:
            chosen = dominating_set(graph, replace(plain, dominators=dominators, rim=rim), map).chosen
            images = tuple(graph.names[i] for i in chosen)
            if images not in known and len(images) < len(map.images):
                known.add(images)
                yield images, f"k = {dominators}" + (" and rim" if rim else "")
