"""Move a map into the frame of known positions of its images, of their own or of Earth."""

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points3D
from slimsfm.errors import InputError
from slimsfm.image_files import named
from slimsfm.mapping.georeference import Georeference, enu_of_wgs84, wgs84_of_enu
from slimsfm.mapping.map import Map
from slimsfm.upkeep.alignment import Alignment, in_new_frame
from slimsfm.upkeep.positions import KnownPositions
from slimsfm.upkeep.similarity import Similarity, check_determined, fit_similarity
from slimsfm.upkeep.stretch import check_not_stretched

_OWN_AXES, _EARTH_AXES = ("x", "y", "z"), ("east-west", "north-south", "up")
_UPSIDE_DOWN = -0.5  # mean of the z components of what is up in the pictures


def align_to_positions(map: Map, known: KnownPositions) -> Alignment:
    """Move a map to where known positions say that its images were taken.

    Raises:
        InputError: Too few names are in the map, or the positions do not determine the result, or contradict
            the images.
    """
    names = [name for name in sorted(known.by_name) if name in map.images]
    notes = _check_names(map, known, names)
    centers = np.array([map.images[name].projection_center() for name in names]).reshape(-1, 3)
    positions = np.array([known.by_name[name] for name in names], np.float64).reshape(-1, 3)
    origin, target = (
        (positions[0], enu_of_wgs84(positions, positions[0])) if known.is_geographic else (None, positions)
    )
    axes = _EARTH_AXES if known.is_geographic else _OWN_AXES
    check_not_stretched(centers, target, known.source, axes)
    found = fit_similarity(centers, target)
    check_determined(found, centers, known.source)
    place, new_from_old = None, found.target_from_source
    if origin is not None:
        _check_upright(map, found, known.source)
        place, new_from_old = _around_box(map, found, origin, centers, positions)
    count = int(found.is_inlier.sum())
    by = f"{count} {known.source}"
    return Alignment(
        map=in_new_frame(map, new_from_old, by, unit="metre", georeference=place),
        new_from_old=new_from_old,
        by=by,
        used=len(names),
        inliers=count,
        outliers=tuple(name for name, kept in zip(names, found.is_inlier, strict=True) if not kept),
        residuals=found.residuals[found.is_inlier],
        residual_unit="m",
        scale_bound=found.scale_bound,
        turn_bound_deg=found.turn_bound_deg,
        heading_bound_deg=found.heading_bound_deg,
        notes=notes,
    )


def _check_names(map: Map, known: KnownPositions, names: list[str]) -> tuple[str, ...]:
    """What was left out; fails if nothing else is there."""
    if not names:
        raise InputError(
            f"none of the {len(known.by_name)} names of the {known.source}, such as {min(known.by_name)!r}, "
            f"is an image of the map, such as {next(iter(map.images))!r}; give names as the map has them"
        )
    unknown = sorted(known.by_name.keys() - map.images.keys())
    return (*known.notes, *([named("name(s) not in the map", unknown)] if unknown else []))


def _around_box(
    map: Map,
    found: Similarity,
    origin: Float64[np.ndarray, "3"],
    centers: Points3D,
    positions: Float64[np.ndarray, "n 3"],
) -> tuple[Georeference, pycolmap.Sim3d]:
    """The place of the center of the box, and the similarity to east, north and up there."""
    (place,) = wgs84_of_enu((found.target_from_source * map.box.center)[None], origin)
    kept = found.is_inlier
    new_from_old = pycolmap.estimate_sim3d(centers[kept], enu_of_wgs84(positions[kept], place))
    if new_from_old is None:  # the same positions gave one before
        raise InputError("the positions do not determine a similarity")
    latitude, longitude, height = place.tolist()
    return Georeference(latitude=latitude, longitude=longitude, height=height), new_from_old


def _check_upright(map: Map, found: Similarity, what: str) -> None:
    """Positions in a plane that are a mirror image turn the map upside down instead of contradicting it."""
    turn = found.target_from_source.rotation
    ups = [turn * -image.cam_from_world().rotation.matrix()[1] for image in map.images.values()]
    if np.mean(ups, axis=0)[2] < _UPSIDE_DOWN:
        raise InputError(
            f"the {what} turn the map upside down: two coordinates are swapped, or one has the wrong sign"
        )
