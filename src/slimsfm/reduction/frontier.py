"""The cost, told beforehand: what many ways to reduce a map keep and what they are predicted to lose."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from slimsfm.errors import MapError
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction.choice import DOMINATING, Candidate, Choice, Maker, points_seen
from slimsfm.reduction.forecast import Prediction, Trials
from slimsfm.reduction.images import ReductionOptions, dominating_set
from slimsfm.selection import SELECTORS
from slimsfm.selection.leave_one_out import LeftOut
from slimsfm.selection.problem import SelectionProblem
from slimsfm.selection.usable_points import selection_problem

Weigh = Callable[[Map], int]
"""Tells how many bytes a map takes on disk."""

USES = ("direct", "images")
"""What a reduced map can be for: matching points directly, or matching image with image."""


@dataclass(frozen=True, kw_only=True)
class FrontierOptions:
    """Which ways to reduce a map are compared."""

    uses: tuple[str, ...] = ("direct",)
    """What the reduced map is for: direct, images or both."""

    selectors: tuple[str, ...] = ("information", "kcover")
    """Who chooses points."""

    budgets: tuple[int, ...] = (100, 150, 200, 300, 400, 600, 800, 1200, 1600, 2400, 3200)
    """Numbers of points to choose."""

    dominators: tuple[int, ...] = (1, 2, 3)
    """How many dominators an image is to have where images are chosen."""

    rim: tuple[bool, ...] = (False, True)
    """Whether the rim of the capture is kept where images are chosen."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        for name, known in (("uses", USES), ("selectors", tuple(SELECTORS))):
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Frontier:
    """What a map can be reduced to."""

    full: Prediction
    """How the full map, matched image by image, localizes references that are left out."""

    candidates: tuple[Candidate, ...]
    """What was tried, by use and method."""

    def is_dominated(self, one: Candidate) -> bool:
        """Whether another candidate for the same use is no larger and loses no more, and is better in one."""
        return any(
            other.choice.use == one.choice.use
            and (other.bytes, other.loss) != (one.bytes, one.loss)
            and other.bytes <= one.bytes
            and other.loss <= one.loss
            for other in self.candidates
        )


def frontier(
    map: Map,
    graph: ReferenceGraph | None,
    weigh: Weigh,
    options: FrontierOptions = FrontierOptions(),
    progress: ProgressBar = silent,
) -> Frontier:
    """Try many ways to reduce a map on its own references.

    Args:
        map: The map.
        graph: Its reference graph; None where only points are to be chosen.
        weigh: Tells the size of a map.
        options: What to try.
        progress: Told of each reference and each candidate.

    Raises:
        MapError: The map was made for direct matching alone, or built without a detector.
        ValueError: Images are to be chosen but there is no graph.
    """
    check_has_features(map)
    if not map.has_keypoints:
        raise MapError(
            "the map was built without a detector: what it loses cannot be foretold from its features; "
            "choose images by `slimsfm reduce MAP -o SMALL --solver exact`"
        )
    if graph is None and "images" in options.uses:
        raise ValueError("graph must be given where images are to be chosen")
    left_out = LeftOut(map)
    trials, maker = Trials(map, left_out), Maker(map)
    problem = selection_problem(map, left_out, progress) if "direct" in options.uses else None
    full = trials.full(trials.tests, progress)
    candidates = []
    for choice in progress(list(_choices(map, graph, problem, options)), "predict candidates"):
        prediction = trials.images(choice.images) if choice.use == "images" else trials.points(choice.points)
        candidates.append(
            Candidate(
                choice=choice,
                bytes=weigh(maker.make(choice)),
                prediction=prediction,
                full=full.of(prediction.tests),
            )
        )
    return Frontier(full=full, candidates=tuple(candidates))


def try_images(map: Map, names: Iterable[str], weigh: Weigh, progress: ProgressBar = silent) -> Candidate:
    """Predict what keeping these images does; the others are the tests.

    Raises:
        InputError: A name is not that of a reference image, or no name is given.
    """
    images = tuple(sorted(set(names)))
    slim = keep_images(map, images)
    trials = Trials(map, LeftOut(map))
    choice = Choice(
        use="images",
        method="images",
        detail=", ".join(images),
        images=images,
        points=points_seen(map, images),
    )
    prediction = trials.images(images)
    full = trials.full(prediction.tests, progress)
    return Candidate(choice=choice, bytes=weigh(slim), prediction=prediction, full=full)


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
    for budget in sorted(set(options.budgets)):
        points = np.sort(SELECTORS[selector](problem, budget, seed=options.seed))
        if len(points):
            yield Choice(
                use="direct", method=selector, detail=f"{len(points)} points", images=(), points=points
            )
        if len(points) < budget:
            return  # there are no more


def _image_sets(
    map: Map, graph: ReferenceGraph, options: FrontierOptions
) -> Iterator[tuple[tuple[str, ...], str]]:
    known = set()
    for rim in options.rim:
        for dominators in options.dominators:
            asked = ReductionOptions(dominators=dominators, rim=rim, seed=options.seed)
            chosen = dominating_set(graph, asked, map).chosen
            images = tuple(graph.names[i] for i in chosen)
            if images not in known and len(images) < len(map.images):
                known.add(images)
                yield images, f"k = {dominators}" + (" and rim" if rim else "")
