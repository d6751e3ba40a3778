"""`slimsfm info`."""

import json as json_format
from dataclasses import asdict

import numpy as np
import pycolmap

from slimsfm.cli.options import MapPath
from slimsfm.cli.output import console, counts, place_of, plural, print_notes, size
from slimsfm.localization.calibration import CALIBRATED
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.io import bytes_by_part, read_map
from slimsfm.mapping.map import Map


def info(map: MapPath, /, json: bool = False, images: bool = False) -> None:
    """Show what a map contains.

    Args:
        map: A map.
        json: Print JSON for programs, which includes the corners of the box.
        images: List the names of the reference images.
    """
    map_, sizes = read_map(map), bytes_by_part(map)
    if json:
        print(json_format.dumps(_facts(map_, sizes), indent=2))
        return
    for name, text in _lines(map_, sizes).items():
        console.print(f"{name:<14}{text}")
    print_notes(map_)
    if images:
        console.print(f"{'image names':<14}{', '.join(map_.images)}")


def _facts(map: Map, sizes: dict[str, int]) -> dict:
    box, parts, info = map.box, counts(map), map.info
    return {
        "kind": map.kind,
        "images": list(map.images),
        "points": parts["points"],
        "observations": parts["observations"],
        "mean_track_length": round(map.model.compute_mean_track_length(), 3),
        "mean_reprojection_error_px": round(map.model.compute_mean_reprojection_error(), 4),
        "verified_pairs": len(map.matches),
        "box": {"diagonal": box.diagonal, "source": info.box_source, "corners": box.corners.tolist()},
        "unit": info.unit,
        "georeference": info.georeference and info.georeference.to_json(),
        "extractor": {
            "name": info.extractor,
            "options": info.extractor_options,
            "confidence_calibrated": info.extractor in CALIBRATED,
        },
        "origin": info.origin,
        "notes": list(info.notes),
        "orientation": info.orientation,
        "exif_orientations": {
            name: tag for name, tag in info.exif_orientations.items() if name in map.images
        },
        "quality": asdict(info.quality) if info.quality else None,
        "bytes": sizes,
    }


def _lines(map: Map, sizes: dict[str, int]) -> dict[str, str]:
    """The facts that a person needs. A map of points only has no observations."""
    model, parts, info = map.model, counts(map), map.info
    points = plural(parts["points"], "point")
    if parts["observations"]:
        points += (
            f", {plural(parts['observations'], 'observation')}, "
            f"mean track length {model.compute_mean_track_length():.1f}, "
            f"mean reprojection error {model.compute_mean_reprojection_error():.2f} px"
        )
    matches = f", {plural(len(map.matches), 'verified pair')}" if map.matches else ""
    options = ", ".join(f"{key} {value}" for key, value in info.extractor_options.items())
    uncalibrated = "" if info.extractor in CALIBRATED else "; confidence not calibrated for this extractor"
    unit = "map units (unknown scale)" if info.unit == "unknown" else info.unit
    support = {"support": map.info.quality.summary} if map.info.quality else {}
    return {
        "map": map.describe(),
        "images": f"{len(map.images)}{matches}",
        "points": points,
        **support,
        "box": f"{info.box_source}, diagonal {map.box.diagonal:.3g} {unit}",
        **({"place": _place(info.georeference)} if info.georeference else {}),
        "extractor": info.extractor + (f" ({options})" if options else "") + uncalibrated,
        "pixels": _pixels(map),
        "size": ", ".join(f"{part} {size(number)}" for part, number in sizes.items()),
    }


def _place(georeference: Georeference) -> str:
    is_enu = np.allclose(georeference.enu_from_world.params, pycolmap.Sim3d().params)
    axes = "axes east, north, up" if is_enu else "in a frame of its own"
    return f"{place_of(georeference)} (origin); {axes}"


def _pixels(map: Map) -> str:
    if map.info.orientation == "stored":
        return "as stored, ignoring EXIF orientation"
    turned = sum(name in map.images for name in map.info.exif_orientations)
    return f"upright ({turned} of {plural(len(map.images), 'image')} turned by EXIF)" if turned else "upright"
