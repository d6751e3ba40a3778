"""Set wrong poses of a map right, or drop the images."""

from collections.abc import Collection
from dataclasses import dataclass, replace

from slimsfm.errors import MapError
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.progress import ProgressBar, silent, single_step
from slimsfm.upkeep.checking import check_is_full, matches_of, wrong_poses
from slimsfm.upkeep.extension import NewImage, extend_map
from slimsfm.upkeep.findings import MapCheck, WrongPose, listed
from slimsfm.upkeep.origins import focal_origins

_SETS = 2  # of references that must agree on a pose before an image is set there
_MAX_ERROR = 0.05  # predicted relative corner error of such a pose
_MIN_OBSERVATIONS = 15  # of an image that was set right
_FEWEST = 2  # images of a map


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """A map whose wrong poses were set right or left out."""

    map: Map
    """The new map; the given one itself if nothing was wrong."""

    moved: tuple[str, ...]
    """Images that now stand where the others say, by name."""

    dropped: tuple[str, ...]
    """Images that were left out, because the others do not say for sure where they stand, by name."""


def repair(map: Map, found: MapCheck, *, progress: ProgressBar = silent) -> Repaired:
    """Register images again whose poses are wrong, where the others say that they stand.

    The images are taken out with all they contributed: their observations, and the points that fewer than two
    others see. Each then gets the pose by the others, its matches are triangulated, and its pose is adjusted,
    while all other images and points stay as they are, bit for bit. An image is dropped if fewer than two
    disjoint sets of references agree where it stands, if the predicted error is above 0.05 of the diagonal,
    if it observes fewer than 15 points in the end, or if a check finds it wrong there too. So are misplaced
    images, which no others localize elsewhere.

    Args:
        map: The map.
        found: What `check` found in it.
        progress: Progress callback.

    Raises:
        MapError: The map was reduced, or fewer than two images have right poses.
        ValueError: The findings are of another map.
    """
    check_is_full(map)
    if unknown := set(found.wrong_names) - map.images.keys():
        raise ValueError(f"found must be of this map, which has no image {min(unknown)!r}")
    if not found.wrong_names:
        return Repaired(map=map, moved=(), dropped=())
    right = [name for name in map.images if name not in found.wrong_names]
    if len(right) < _FEWEST:
        raise MapError("no two images have poses that agree; build the map again")
    matches = matches_of(map, progress)
    kept = keep_images(replace(map, matches=matches), right, min_track_length=2)
    misplaced = {one.name for one in found.misplaced}
    sure = [one for one in found.wrong if _is_sure(one, misplaced)]
    with single_step(progress, "register images again"):
        extended = _registered(map, kept, sure, matches) if sure else kept
    seen, still = extended.observations, _still_wrong(extended, sure, progress)
    moved = tuple(
        one.name for one in sure if len(seen[one.name].rows) >= _MIN_OBSERVATIONS and one.name not in still
    )
    made = extended
    if len(moved) < len(sure):
        made = keep_images(extended, [*right, *moved], min_track_length=2)
    dropped = tuple(name for name in found.wrong_names if name not in moved)
    return Repaired(map=_described(made, map, moved, dropped), moved=moved, dropped=dropped)


def _still_wrong(extended: Map, sure: list[WrongPose], progress: ProgressBar) -> set[str]:
    """The images that a check finds wrong again where they were set: look-alikes may mislead twice."""
    return {one.name for one in wrong_poses(extended, progress)} if sure else set()


def _is_sure(one: WrongPose, misplaced: Collection[str]) -> bool:
    """Whether enough sets of references say well enough where an image stands, none of them misplaced."""
    is_reliable = not any(set(some) & set(misplaced) for some in one.sets)
    return is_reliable and len(one.sets) >= _SETS and one.predicted_error <= _MAX_ERROR


def _registered(map: Map, kept: Map, sure: list[WrongPose], matches: Matches) -> Map:
    new = {
        one.name: NewImage(
            features=map.features[one.name],
            camera=map.camera(one.name),
            cam_from_world=one.others_cam_from_world,
            image_id=map.images[one.name].image_id,
        )
        for one in sure
    }
    names = kept.images.keys() | new.keys()
    own = {pair: matches[pair] for pair in matches if names >= set(pair) and new.keys() & set(pair)}
    return extend_map(kept, new, own)


def _described(made: Map, map: Map, moved: tuple[str, ...], dropped: tuple[str, ...]) -> Map:
    """The map with notes on what was changed, and with the support measured again."""
    notes = list(map.info.notes)
    if moved:
        notes.append(f"{len(moved)} wrong poses were set right, where the other images say: {listed(moved)}")
    if dropped:
        notes.append(f"{len(dropped)} images with wrong poses were left out: {listed(dropped)}")
    before = map.info.quality
    quality = measure(made.model, made.matches, [*made.images, *dropped])
    if before is not None:
        quality = replace(quality, given=before.given).with_origins(focal_origins(map))
    wrong = tuple(name for name in map.info.wrong_poses if name not in (*moved, *dropped))
    return replace(made, info=replace(map.info, notes=tuple(notes), quality=quality, wrong_poses=wrong))
