"""Tables of disturbed queries in Markdown: rows by disturbance, and reliability by group."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter

import numpy as np

from slimsfm.evaluation.scores import SURE
from slimsfm.geometry import ADD_FRACTIONS

FOUND = 0.5
"""Confidence from which a query counts as found, the default of `LocalizationOptions`."""

LEAST_RIGHT, LEAST_FOUND = 0.95, 0.8
"""Targets: share of right poses of those over `SURE`, and of found and right queries of `RECOVERED`."""

RECOVERED = ("zoom", "crop", "frame", "exif")
"""Groups in which the camera is wrong and can be found out."""

MOST_STRANGE = {"mirrored": 0.01}
"""Largest share of queries that are found though no pose is right, by disturbance; 0 for others."""

_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True, kw_only=True)
class Record:
    """What came of localizing one query in one way."""

    scene: str
    """Name of the scene."""

    method: str
    """Strategy and map."""

    disturbance: str
    """What was done to the query."""

    group: str
    """Class of the disturbance."""

    query: str
    """Name of the query."""

    has_pose: bool
    """Whether a pose can be right."""

    confidence: float
    """Probability that the pose is right; 0 without a pose."""

    error: float
    """Relative corner error; infinite without a pose or if none can be right."""

    bound: float | None
    """Value that the error should be below in 95 of 100 poses; None if there is none."""

    relative_focal_error: float
    """Focal length that was used, relative to the true one, minus 1."""

    inliers: int
    """Inliers of the pose; 0 without one."""

    milliseconds: float
    """Time of matching and pose estimation."""

    @property
    def found(self) -> bool:
        """Whether a pose is reported."""
        return self.confidence >= FOUND

    @property
    def sure(self) -> bool:
        """Whether the pose is reported as nearly certain."""
        return self.confidence > SURE

    @property
    def right(self) -> bool:
        """Whether the pose is right."""
        return self.error < ADD_FRACTIONS[0]


def report(records: Sequence[Record], before: Sequence[Record] = ()) -> str:
    """All tables: for each method all scenes together and each scene, then reliability.

    Records of an earlier version are compared where it localized the same queries.
    """
    lines: list[str] = []
    for method in _distinct(one.method for one in records):
        some = [one for one in records if one.method == method]
        lines += [f"## {method}", "", "### all scenes", "", *disturbance_table(some)]
        lines += [*missed_targets(some), ""]
        if before:
            lines += ["### before and after", "", *comparison_table(before, some)]
        for scene in _distinct(one.scene for one in some):
            lines += [f"### {scene}", "", *disturbance_table([one for one in some if one.scene == scene])]
        lines += ["### reliability by group", "", *group_table(some)]
        lines += ["### reliability by confidence", "", *reliability_table(some)]
        lines += ["### bounds by scene", "", *bound_table(some)]
    return "\n".join(lines)


def disturbance_table(records: Sequence[Record]) -> list[str]:
    """A row for each disturbance."""
    head = (
        "disturbance",
        "queries",
        "found",
        "found and right",
        f"over {SURE}",
        "wrong of these",
        "median error of found",
        "focal length off",
        "error under its bound",
    )
    rows = []
    for name in _distinct(one.disturbance for one in records):
        some = [one for one in records if one.disturbance == name]
        found, sure = [one for one in some if one.found], [one for one in some if one.sure]
        errors = [one.error for one in found if one.has_pose]
        focal = [abs(one.relative_focal_error) for one in found if one.has_pose]
        rows.append(
            (
                name,
                f"{len(some)}",
                f"{len(found)}",
                f"{sum(one.right for one in found)}",
                f"{len(sure)}",
                f"{sum(not one.right for one in sure)}",
                f"{np.median(errors):.4f}" if errors else "",
                f"{np.median(focal):.1%}" if focal else "",
                coverage(found),
            )
        )
    return _table(head, rows)


def missed_targets(records: Sequence[Record]) -> list[str]:
    """A line for each disturbance that misses a target."""
    lines = []
    for name in _distinct(one.disturbance for one in records):
        some = [one for one in records if one.disturbance == name]
        sure, found = [one for one in some if one.sure], [one for one in some if one.found]
        if some[0].has_pose and sum(one.right for one in sure) < LEAST_RIGHT * len(sure):
            lines.append(f"- {name}: fewer than {LEAST_RIGHT:.0%} of the poses over {SURE} are right")
        if some[0].group in RECOVERED and sum(one.right for one in found) < LEAST_FOUND * len(some):
            lines.append(f"- {name}: fewer than {LEAST_FOUND:.0%} of the queries are found and right")
        if not some[0].has_pose and len(found) > MOST_STRANGE.get(name, 0) * len(some):
            lines.append(f"- {name}: {len(found)} of {len(some)} queries without a right pose are found")
    return lines


def comparison_table(before: Sequence[Record], after: Sequence[Record]) -> list[str]:
    """What became of the same queries: found, right of these, over `SURE` and wrong of these."""
    key = attrgetter("scene", "method", "disturbance", "query")
    common = {key(one) for one in before} & {key(one) for one in after}
    rows = []
    for name in _distinct(one.disturbance for one in after):
        cells: list[str] = []
        for records in (before, after):
            some = [one for one in records if one.disturbance == name and key(one) in common]
            found, sure = [one for one in some if one.found], [one for one in some if one.sure]
            right, wrong = sum(one.right for one in found), sum(not one.right for one in sure)
            cells += [f"{right} of {len(found)}", f"{wrong} of {len(sure)}"]
        rows.append((name, *cells))
    head = [f"{what} {when}" for when in ("before", "after") for what in ("right of found", "wrong of sure")]
    return _table(("disturbance", *head), rows)


def group_table(records: Sequence[Record]) -> list[str]:
    """Calibration of the confidence for each group, and for all."""
    rows = []
    for group in (*_distinct(one.group for one in records), "all"):
        some = [one for one in records if group in (one.group, "all") and one.inliers]
        if not some:
            rows.append((group, "0", "", "", "", ""))
            continue
        sure = [one for one in some if one.sure]
        rows.append(
            (
                group,
                f"{len(some)}",
                f"{np.mean([one.confidence for one in some]):.3f}",
                f"{np.mean([one.right for one in some]):.3f}",
                f"{calibration_error(some):.3f}",
                f"{np.mean([one.right for one in sure]):.1%} of {len(sure)}" if sure else "",
            )
        )
    head = ("group", "poses", "mean confidence", "right", "calibration error", f"right over {SURE}")
    return _table(head, rows)


def reliability_table(records: Sequence[Record]) -> list[str]:
    """How many poses of each confidence are right, over all groups and in each."""
    groups = _distinct(one.group for one in records)
    rows = []
    for low, high, some in _binned([one for one in records if one.inliers]):
        parts = [[one.right for one in some if one.group == group] for group in groups]
        shares = [f"{sum(part)} of {len(part)}" if part else "" for part in parts]
        mean, right = (np.mean([getattr(one, of) for one in some]) for of in ("confidence", "right"))
        rows.append((f"{low} to {high}", f"{len(some)}", f"{mean:.3f}", f"{right:.3f}", *shares))
    return _table(("confidence", "poses", "mean", "right", *groups), rows)


def bound_table(records: Sequence[Record]) -> list[str]:
    """The share of true errors under their bounds in each scene: clean, of right poses, and of found ones."""
    rows = []
    for scene in _distinct(one.scene for one in records):
        found = [one for one in records if one.scene == scene and one.found]
        clean = [one for one in found if one.group == "clean"]
        rows.append((scene, coverage(clean), coverage([o for o in found if o.right]), coverage(found)))
    return _table(("scene", "clean", "right", "found"), rows)


def calibration_error(records: Sequence[Record]) -> float:
    """Expected calibration error: |mean confidence - share right| over the bins, weighted by their counts."""
    gaps = [
        len(some) * abs(np.mean([one.confidence - one.right for one in some]))
        for _, _, some in _binned(records)
    ]
    return float(sum(gaps) / len(records))


def coverage(records: Sequence[Record]) -> str:
    """The share of true errors that lie under their bound."""
    held = [one.error <= one.bound for one in records if one.has_pose and one.bound is not None]
    return f"{np.mean(held):.0%} of {len(held)}" if held else ""


def _binned(records: Sequence[Record]) -> Iterator[tuple[float, float, list[Record]]]:
    """Bounds and records of each bin of confidence that is not empty."""
    for low, high in pairwise(_BINS):
        last = high == _BINS[-1]
        some = [one for one in records if low <= one.confidence and (one.confidence < high or last)]
        if some:
            yield low, high, some


def _distinct(values: Iterator[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(row) + " |" for row in (head, *rows)]
    return [lines[0], "|---" + "|---:" * (len(head) - 1) + "|", *lines[1:], ""]
