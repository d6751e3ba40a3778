"""`slimsfm align`."""

import json as json_format
from dataclasses import dataclass
from pathlib import Path

from slimsfm.cli.options import MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, place_of, print_warnings
from slimsfm.errors import InputError
from slimsfm.mapping.io import read_map, write_map
from slimsfm.progress import shown
from slimsfm.upkeep.align import By, Distance, Gps, GravityUp, OtherMap, Positions, Tag, align
from slimsfm.upkeep.alignment import Alignment
from slimsfm.upkeep.positions import read_positions
from slimsfm.upkeep.tags import Family
from slimsfm.upkeep.up import read_down

_WAYS = "distance, tag-size, positions, gps, to, up or gravity"


@dataclass(frozen=True, kw_only=True)
class AlignArguments:
    """What to align a map by: one of these."""

    distance: float | None = None
    """Distance in meters of the two images or points that `--between` names."""

    between: tuple[str, ...] = ()
    """Two images by name, or two points by their id in the COLMAP model."""

    tag_size: float | None = None
    """Side in meters of the black square of printed tags that the photos in `--images` show."""

    tag_family: Family = "apriltag-36h11"
    """Family of the tags."""

    tag_number: int | None = None
    """The tag that has this size, where the photos show others too. By default all have."""

    positions: Path | None = None
    """Known positions of images: CSV with the columns name, x, y, z in meters, or name, latitude, longitude,
    height."""

    gps: bool = False
    """GPS in the EXIF data of the photos in `--images`."""

    to: Path | None = None
    """Another map of the same place, whose frame is taken over."""

    up: bool = False
    """Turn the z axis up, by how the photos were held."""

    gravity: Path | None = None
    """Turn the z axis up, by measured gravity: JSON with the direction down, in the frame of the map,
    {"world": [x, y, z]}, or in those of cameras, {"images": {NAME: [x, y, z]}}."""

    images: Path | None = None
    """Folder of the photos that the map was built from."""

    def __post_init__(self) -> None:
        for name in ("distance", "tag_size"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name.replace('_', '-')} must be positive, got {value}")

    def by(self) -> By:
        """The way that was chosen, with its files read.

        Raises:
            InputError: None or several were, one lacks what it needs, or a file cannot be used.
        """
        ways = (self.distance, self.tag_size, self.positions, self.to, self.gravity)
        if sum(way is not None for way in ways) + self.gps + self.up != 1:
            raise InputError(f"give one of {_WAYS}; see slimsfm align --help")
        if self.distance is not None:
            if len(self.between) != 2:
                raise InputError("distance needs --between A B: two images of the map, or ids of two points")
            return Distance(between=(self.between[0], self.between[1]), meters=self.distance)
        if self.tag_size is not None:
            folder = self._photos("tag-size")
            return Tag(images=folder, side=self.tag_size, family=self.tag_family, number=self.tag_number)
        if self.gps:
            return Gps(images=self._photos("gps"))
        if self.positions is not None:
            return Positions(known=read_positions(self.positions))
        if self.to is not None:
            return OtherMap(map=read_map(self.to))
        return GravityUp(down=None if self.gravity is None else read_down(self.gravity))

    def _photos(self, way: str) -> Path:
        if self.images is None:
            raise InputError(f"{way} needs --images FOLDER: the photos that the map was built from")
        return self.images


def align_map(
    map: MapPath,
    /,
    output: OutputPath,
    by: AlignArguments = AlignArguments(),
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Give a map its unit and its place: meters, up, and the frame of known positions, Earth or another map.

    Says what the result rests on and how exact it is. What the given data do not determine, or what
    contradicts itself or the photos, is refused.

    Args:
        map: A full or reduced map.
        output: Where to write the aligned map.
        by: What to align it by.
        json: Print JSON for programs.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, map, by.positions, by.to, by.gravity, by.images, overwrite=overwrite)
    way = by.by()
    found = align(read_map(map), way, progress=shown)
    write_map(found.map, output, overwrite=overwrite)
    if json:
        print(json_format.dumps(_facts(found), indent=2))
        return
    for note in found.notes:
        console.print(f"note: {note}", style="yellow")
    print_warnings(found.map)
    for line in _lines(found):
        console.print(line)
    finish(f"{output}: written", watch, "info", output)


def _lines(found: Alignment) -> list[str]:
    agree = f", {found.inliers} of {found.used} agree" if found.used > 1 else ""
    lines = [f"aligned by {found.by}{agree}"]
    if found.outliers:
        lines.append(f"left out because they disagree: {', '.join(found.outliers)}")
    if found.scale_bound is not None:
        per = "m" if found.map.info.unit == "metre" else "units of the other map"
        lines.append(
            f"scale: {found.new_from_old.scale:.5g} {per} per unit of before, within "
            f"{_share(found.scale_bound)}"
        )
    if found.turn_bound_deg is not None:
        heading = found.heading_bound_deg if found.map.info.georeference else None
        also = "" if heading is None else f", heading within {heading:.2g}°"
        lines.append(f"rotation: within {found.turn_bound_deg:.2g}°{also}")
    if len(found.residuals):
        lines.append(
            f"residuals: median {_length(found.median_residual or 0, found.residual_unit)}, "
            f"largest {_length(found.max_residual or 0, found.residual_unit)}"
        )
    if found.map.info.georeference:
        lines.append(f"place: {place_of(found.map.info.georeference)}")
    if found.scale_bound is not None or found.turn_bound_deg is not None:
        lines.append('("within": with 95 % probability, if errors are independent)')
    return lines


def _share(share: float) -> str:
    return f"{100 * share:.2g} %"


def _length(value: float, unit: str) -> str:
    if unit == "m" and value < 1:
        return f"{100 * value:.2g} cm"
    return f"{value:.3g}{'' if unit == '°' else ' '}{unit}"


def _facts(found: Alignment) -> dict:
    info, moved = found.map.info, found.new_from_old
    return {
        "by": found.by,
        "used": found.used,
        "inliers": found.inliers,
        "outliers": list(found.outliers),
        "residual_unit": found.residual_unit,
        "median_residual": found.median_residual,
        "max_residual": found.max_residual,
        "scale_bound_95": found.scale_bound,
        "rotation_bound_95_deg": found.turn_bound_deg,
        "heading_bound_95_deg": found.heading_bound_deg,
        "new_from_old": {
            "scale": float(moved.scale),
            "quaternion_xyzw": moved.rotation.quat.tolist(),
            "translation": moved.translation.tolist(),
        },
        "unit": info.unit,
        "georeference": info.georeference and info.georeference.to_json(),
        "notes": list(found.notes),
    }
