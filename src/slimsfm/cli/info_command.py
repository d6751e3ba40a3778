"""`slimsfm info`."""

import json
from pathlib import Path

from slimsfm.cli.options import MapPath
from slimsfm.cli.output import console, counts, size
from slimsfm.mapping.io import bytes_by_part, read_map


def info(map: MapPath, /, json: bool = False, images: bool = False) -> None:
    """Tell what is in a map.

    Args:
        map: A map.
        json: Print JSON, for programs.
        images: List the names of the reference images.
    """
    facts = _facts(map)
    if json:
        print(_to_json(facts))
        return
    for name, value in facts.items():
        if name == "images":
            console.print(f"{name:<24}{len(value)}" + (f": {', '.join(value)}" if images else ""))
        elif name == "bytes":
            console.print(f"{name:<24}" + ", ".join(f"{part} {size(n)}" for part, n in value.items()))
        else:
            console.print(f"{name:<24}{value}")


def _facts(path: Path) -> dict:
    map_ = read_map(path)
    extractor = {"name": map_.info.extractor, "options": map_.info.extractor_options}
    box = map_.box
    parts = counts(map_)
    return {
        "images": list(map_.images),
        "points": parts["points"],
        "observations": parts["observations"],
        "mean_track_length": round(map_.model.compute_mean_track_length(), 3),
        "mean_reprojection_error_px": round(map_.model.compute_mean_reprojection_error(), 4),
        "verified_pairs": len(map_.matches),
        "box": {"diagonal": box.diagonal, "source": map_.info.box_source, "corners": box.corners.tolist()},
        "unit": map_.info.unit,
        "extractor": extractor,
        "origin": map_.info.origin,
        "bytes": bytes_by_part(path),
    }


def _to_json(facts: dict) -> str:
    return json.dumps(facts, indent=2)
