"""Give a map its unit and its place: meters, up, and the frame of known positions, Earth or another map."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.alignment import Alignment, in_new_frame
from slimsfm.upkeep.between_maps import similarity_between
from slimsfm.upkeep.lengths import distance_between
from slimsfm.upkeep.places import align_to_positions
from slimsfm.upkeep.positions import KnownPositions, read_gps
from slimsfm.upkeep.scale_of_tags import scale_of_tags
from slimsfm.upkeep.tags import Family, find_tags
from slimsfm.upkeep.up import Down, level_from_world, up_of


@dataclass(frozen=True, kw_only=True)
class Distance:
    """A measured distance between two camera positions or two points of the map."""

    between: tuple[str, str]
    """Names of two images, or ids of two points of the COLMAP model."""

    meters: float
    """Their distance."""

    def __post_init__(self) -> None:
        if not 0 < self.meters < np.inf:
            raise ValueError(f"meters must be positive, got {self.meters}")


@dataclass(frozen=True, kw_only=True)
class Tag:
    """Printed tags of one known size in the photos."""

    images: Path
    """Folder of the photos of the map."""

    side: float
    """Length of a side of the black square, in meters."""

    family: Family = "apriltag-36h11"
    """Family of the tags."""

    number: int | None = None
    """The tag to use, where the photos show others of another size; all if not given."""

    def __post_init__(self) -> None:
        if not 0 < self.side < np.inf:
            raise ValueError(f"side must be positive, got {self.side}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Positions:
    """Known positions of images, see `read_positions`."""

    known: KnownPositions
    """The positions."""


@dataclass(frozen=True, kw_only=True)
class Gps:
    """The GPS positions in the EXIF data of the photos."""

    images: Path
    """Folder of the photos of the map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherMap:
    """The frame of another map that shows the same place."""

    map: Map
    """The other map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GravityUp:
    """The z axis up; position, heading and scale stay."""

    down: Down | None = None
    """Measured gravity; by default the cameras are taken to be held level."""


By = Distance | Tag | Positions | Gps | OtherMap | GravityUp


def align(map: Map, by: By, *, progress: ProgressBar = silent) -> Alignment:
    """Move a full or reduced map into a frame that means something.

    - `Distance` and `Tag` give meters. The frame only grows or shrinks about its origin.
    - `Positions` give meters and the frame of the positions. If these are latitude, longitude and height, or
      with `Gps`, the frame has its origin at the center of the box and axes east, north and up, and the map
      knows its place (`info.georeference`).
    - `OtherMap` gives frame, unit and place of another map.
    - `GravityUp` turns the z axis up.

    A map that knows its place keeps it when it is only scaled or turned upright.

    Args:
        map: The map; it is not changed.
        by: What to align it by.
        progress: Progress bar, where photos are read or localized.

    Returns:
        The aligned map, and how well it is determined.

    Raises:
        InputError: What is given names nothing in the map, does not determine the result, contradicts itself,
            or contradicts the images.
        ImageError: A photo cannot be read.
    """
    match by:
        case Distance():
            return _by_distance(map, by)
        case Tag():
            return _by_tag(map, by, progress)
        case Positions():
            return align_to_positions(map, by.known)
        case Gps():
            return align_to_positions(map, read_gps(by.images, map.images))
        case OtherMap():
            return _by_other_map(map, by.map, progress)
        case GravityUp():
            return _by_gravity(map, by)


def _by_distance(map: Map, by: Distance) -> Alignment:
    measured = distance_between(map, *by.between)
    scaling = _scaling(by.meters / measured.length)
    name = f"the distance of {' and '.join(by.between)}"
    return Alignment(
        map=in_new_frame(map, scaling, name, unit="metre", georeference=map.info.georeference),
        new_from_old=scaling,
        by=name,
        used=1,
        inliers=1,
        residuals=np.zeros(0),
        residual_unit="m",
        scale_bound=measured.relative_bound,
    )


def _by_tag(map: Map, by: Tag, progress: ProgressBar) -> Alignment:
    views = find_tags(map, by.images, by.family, progress=progress)
    found = scale_of_tags(map, views, by.side, by.number)
    scaling = _scaling(found.scale)
    numbers = ", ".join(str(tag.number) for tag in found.tags)
    name = f"tag{'s' * (len(found.tags) > 1)} {numbers} of {by.side:g} m"
    return Alignment(
        map=in_new_frame(map, scaling, name, unit="metre", georeference=map.info.georeference),
        new_from_old=scaling,
        by=name,
        used=sum(tag.views for tag in found.tags),
        inliers=sum(len(tag.errors_px) for tag in found.tags),
        outliers=tuple(sorted({name for tag in found.tags for name in tag.outliers})),
        residuals=np.concatenate([tag.errors_px for tag in found.tags]),
        residual_unit="px",
        scale_bound=found.relative_bound,
        notes=found.notes,
    )


def _scaling(scale: float) -> pycolmap.Sim3d:
    return pycolmap.Sim3d(float(scale), pycolmap.Rotation3d(), np.zeros(3))


def _by_other_map(map: Map, other: Map, progress: ProgressBar) -> Alignment:
    found = similarity_between(other, map, progress=progress)
    pairs, number = found.pairs, int(found.is_inlier.sum())
    name = f"{number} {pairs.how} of another map"
    moved = in_new_frame(
        map, found.target_from_source, name, unit=other.info.unit, georeference=other.info.georeference
    )
    return Alignment(
        map=moved,
        new_from_old=found.target_from_source,
        by=name,
        used=len(pairs.names),
        inliers=number,
        outliers=tuple(one for one, kept in zip(pairs.names, found.is_inlier, strict=True) if not kept),
        residuals=found.residuals[found.is_inlier],
        residual_unit="m" if other.info.unit == "metre" else "map units",
        scale_bound=found.scale_bound,
        turn_bound_deg=found.turn_bound_deg,
    )


def _by_gravity(map: Map, by: GravityUp) -> Alignment:
    up = up_of(map, by.down)
    turn = level_from_world(up.direction)
    name = "gravity" if by.down else "the cameras, which were held level"
    number = len(up.deviations_deg)
    return Alignment(
        map=in_new_frame(map, turn, name, unit=map.info.unit, georeference=map.info.georeference),
        new_from_old=turn,
        by=name,
        used=number,
        inliers=number,
        residuals=up.deviations_deg,
        residual_unit="°",
        turn_bound_deg=up.bound_deg,
    )
