"""Check a map: which poses its images contradict, which images nothing supports, and which add nothing."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from slimsfm.errors import MapError
from slimsfm.features import match_nearest, unit_rows
from slimsfm.geometry import rotation_error_deg
from slimsfm.mapping.map import Map
from slimsfm.mapping.matching import verify_matches
from slimsfm.mapping.pairs import Matches, choose_pairs, exhaustive_pairs
from slimsfm.mapping.support import MIN_AGREEING, Pair, agreement, trusted_pairs
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.findings import ContradictedPair, MapCheck, Misplaced, Unlocalized, WrongPose
from slimsfm.upkeep.likeness import find_blurred, find_duplicates
from slimsfm.upkeep.misplaced import Surroundings
from slimsfm.upkeep.threads import find_threads
from slimsfm.upkeep.verdicts import Court, Trial, Verdicts
from slimsfm.upkeep.witnesses import Witnesses

_MOST_EXHAUSTIVE = 60  # images up to which all pairs are matched, if the map has no matches


def check(map: Map, *, images: str | Path | None = None, progress: ProgressBar = silent) -> MapCheck:
    """Check a full map.

    Each image is localized from disjoint sets of the others as if it were a query: by their verified matches,
    in which no pose has a part, and by points that are triangulated without the image. Where several sets
    agree that it stands elsewhere, its pose is wrong. Which poses are wrong is decided jointly: see
    `upkeep.verdicts`. Images that were laid over a place that looks alike are confirmed by what looks alike,
    but do not match the rest: see `upkeep.misplaced`. What else is found is cheap: see `upkeep.threads` and
    `upkeep.likeness`.

    Args:
        map: The map. Without stored matches, its features are matched again, which takes most of the time.
        images: Folder of its photos, to judge sharpness by pixels instead of keypoints.
        progress: Progress callback.

    Raises:
        MapError: The map was reduced, or has neither matches nor keypoints to match again.
        InputError: A photo cannot be read.

    Notes:
        Time is linear in the images: 30 ms each, in all, where an image has a dozen references. The result
        does not depend on anything but the map.
    """
    check_is_full(map)
    matches = matches_of(map, progress)
    witnesses = Witnesses(map, matches)
    agreeing = agreement(map.images, matches)
    verdicts, misplaced = _decide(map, matches, agreeing, witnesses, progress)
    names, wrong = witnesses.names, _wrong_of(map, verdicts)
    out = {one.name for one in (*wrong, *misplaced)}
    neighbors = {name: [names[j] for j in witnesses.neighbors(i)] for i, name in enumerate(names)}
    return MapCheck(
        images=len(names),
        pairs=len(agreeing),
        agreeing_pairs=sum(share >= MIN_AGREEING for share in agreeing.values()),
        matches_from="map" if map.matches else "matched again",
        usual_error=_usual_error(verdicts),
        wrong=wrong,
        misplaced=misplaced,
        contradicted_pairs=_contradicted_pairs(map, matches, agreeing, out),
        unlocalized=_unlocalized(witnesses, verdicts, out),
        duplicates=find_duplicates(map, matches),
        blurred=find_blurred(map, neighbors, None if images is None else Path(images), progress),
        threads=find_threads(names, matches, agreeing, out),
    )


def wrong_poses(map: Map, progress: ProgressBar = silent) -> tuple[WrongPose | Misplaced, ...]:
    """The images of a full map whose poses are wrong, by name, without the other findings of `check`."""
    matches = matches_of(map, progress)
    agreeing = agreement(map.images, matches)
    verdicts, misplaced = _decide(map, matches, agreeing, Witnesses(map, matches), progress)
    return tuple(sorted((*_wrong_of(map, verdicts), *misplaced), key=lambda one: one.name))


def _decide(
    map: Map,
    matches: Matches,
    agreeing: Mapping[Pair, float],
    witnesses: Witnesses,
    progress: ProgressBar,
) -> tuple[Verdicts, tuple[Misplaced, ...]]:
    """Decide which poses are wrong, by images that are not misplaced themselves.

    Parts that contradict the rest of the map are tried by the rest.
    """
    threads = find_threads(witnesses.names, matches, agreeing, ())
    court = Court(witnesses, map.box, progress)
    verdicts = court.decide([one.part for one in threads if one.contradicted])
    if _has_known_poses(map):
        return verdicts, ()
    names, surroundings = witnesses.names, Surroundings(map, matches, agreeing, progress)
    misplaced = surroundings.misplaced({names[i] for i in verdicts.wrong})
    if misplaced and verdicts.wrong:
        verdicts = court.reconsider(verdicts, [names.index(one.name) for one in misplaced])
        misplaced = surroundings.misplaced({names[i] for i in verdicts.wrong})
    return verdicts, misplaced


def check_is_full(map: Map) -> None:
    """Check that a map was not reduced.

    Raises:
        MapError: It was.
    """
    if map.kind != "full":
        raise MapError(
            f"the map was reduced to {map.kind}, and what is left of it cannot contradict it; check the map "
            "that it was reduced from, and reduce it again"
        )


def matches_of(map: Map, progress: ProgressBar = silent) -> Matches:
    """The verified matches of a map; found again, by nearest neighbors, if it stores none.

    Raises:
        MapError: It stores none, and its features have no keypoints that could be matched one by one.
    """
    if map.matches:
        return dict(map.matches)  # read once
    if not map.has_keypoints:
        raise MapError(
            f"the map has no matches, and extractor {map.info.extractor!r} no keypoints to match again; "
            "build it again, or import it with its matches"
        )
    names = list(map.images)
    features = {name: map.features[name] for name in names}
    few = len(names) <= _MOST_EXHAUSTIVE
    pairs = exhaustive_pairs(names) if few else choose_pairs(features, "similar", seed=0)
    units = {name: unit_rows(one.descriptors) for name, one in features.items()}
    found = {
        (a, b): match_nearest(units[a], units[b], map.descriptor_metric)
        for a, b in progress(pairs, "match images again")
    }
    cameras = {name: map.camera(name) for name in names}
    geometries = verify_matches(features, cameras, found, seed=0, progress=progress)
    verified = {pair: np.asarray(one.inlier_matches, np.int64) for pair, one in geometries.items()}
    return {pair: rows.reshape(-1, 2) for pair, rows in verified.items() if len(rows)}


def _wrong_of(map: Map, verdicts: Verdicts) -> tuple[WrongPose, ...]:
    names = list(map.images)
    return tuple(_wrong(map, names[i], verdicts.trials[i]) for i in verdicts.wrong)


def _wrong(map: Map, name: str, trial: Trial) -> WrongPose:
    others, stored = trial.together, map.images[name].cam_from_world()
    if others is None:
        raise ValueError(f"trial must have a pose of {name!r}: nothing else contradicts one")
    centers = [pose.inverse().translation for pose in (others.cam_from_world, stored)]
    return WrongPose(
        name=name,
        cam_from_world=stored,
        others_cam_from_world=others.cam_from_world,
        sets=tuple(one.references for one in trial.contradicting),
        inliers=others.inliers,
        agreeing=others.agreeing,
        distance=others.distance,
        rotation_deg=rotation_error_deg(others.cam_from_world, stored),
        shift=float(np.linalg.norm(centers[0] - centers[1])),
        predicted_error=others.predicted_error,
    )


def _has_known_poses(map: Map) -> bool:
    return map.info.quality is not None and map.info.quality.has_known_poses


def _contradicted_pairs(
    map: Map, matches: Matches, agreeing: Mapping[Pair, float], wrong: Collection[str]
) -> tuple[ContradictedPair, ...]:
    if _has_known_poses(map):
        return ()
    left = {pair: matches[pair] for pair in agreeing if not set(pair) & set(wrong)}
    return tuple(
        ContradictedPair(first=a, second=b, matches=len(left[a, b]), agreeing=agreeing[a, b])
        for a, b in sorted(trusted_pairs(left, [name for name in map.images if name not in wrong]))
        if agreeing[a, b] < MIN_AGREEING
    )


def _unlocalized(witnesses: Witnesses, verdicts: Verdicts, wrong: Collection[str]) -> tuple[Unlocalized, ...]:
    alone = [
        i for i, one in enumerate(verdicts.trials) if not one.testimonies and witnesses.names[i] not in wrong
    ]
    return tuple(
        Unlocalized(
            name=witnesses.names[i],
            references=len(witnesses.neighbors(i)),
            matches=len(np.unique(witnesses.matched(i, witnesses.references(i)).keypoints)),
        )
        for i in alone
    )


def _usual_error(verdicts: Verdicts) -> float:
    """Median distance between the poses of the map that are not wrong and those by the other images."""
    right = [one.together for i, one in enumerate(verdicts.trials) if i not in verdicts.wrong]
    return float(np.median([one.distance for one in right if one] or [np.nan]))
