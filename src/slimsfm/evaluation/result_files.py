"""Results on disk: one JSON file per object, and the results and tables of the whole run.

A pose is stored as seven numbers, the quaternion x y z w of its rotation and its translation, so that reading
returns the written values bit for bit.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from slimsfm.errors import InputError
from slimsfm.evaluation.comparison import (
    Comparison,
    DominationSummary,
    against_full,
    summarize_domination,
)
from slimsfm.evaluation.formats import csv_queries, csv_table, latex_table, markdown_page
from slimsfm.evaluation.result_parsing import object_from_json
from slimsfm.evaluation.results import MapRun, ObjectResult, PosedQuery, Run
from slimsfm.evaluation.table import Row, all_rows
from slimsfm.files import contents_of, plain, read_json, replacing
from slimsfm.graph.edge_sources import Edges

RESULT_FORMAT_VERSION = 1

_NO_RESULT, _AGAIN = "not a result of slimsfm benchmark", "run the benchmark again"


def write_json(path: Path, data: dict) -> None:
    """Write a JSON file, replacing an existing one; numbers must be finite, and paths become text."""
    with replacing(path, overwrite=True) as partial:
        partial.write_text(json.dumps(data, indent=1, allow_nan=False, default=str) + "\n", encoding="utf-8")


def object_to_json(result: ObjectResult) -> dict:
    """The results of an object as plain values."""
    return {
        "name": result.name,
        "box": {"center": result.box.center.tolist(), "half_edges": result.box.half_edges.tolist()},
        "unit": result.unit,
        "images": str(result.images),
        "queries": [_query_to_json(query) for query in result.queries],
        "maps": [asdict(one) for one in result.maps],
        "cells": [
            {
                "method": one.method,
                "strategy": one.strategy,
                "variant": one.variant,
                "trials": [_map_run_to_json(run) for run in one.map_runs],
            }
            for one in result.measurements
        ],
        **({"skipped_queries": dict(result.skipped)} if result.skipped else {}),
        **({"contradicted_images": dict(result.contradicted)} if result.contradicted else {}),
    }


def _query_to_json(query: PosedQuery) -> dict:
    camera = query.camera
    return {
        "path": str(query.path),
        "camera": {
            "model": camera.model_name,
            "width": camera.width,
            "height": camera.height,
            "params": camera.params.tolist(),
        },
        "cam_from_world": _pose_to_json(query.cam_from_world),
        **({"orientation": query.orientation} if query.orientation != "upright" else {}),
    }


def _map_run_to_json(run: MapRun) -> dict:
    outcomes = run.outcomes
    return {
        "references": run.references,
        "points": run.points,
        "map_bytes": run.map_bytes,
        "error": _finite(outcomes.error),
        "rotation_deg": _finite(outcomes.rotation_deg),
        "translation": _finite(outcomes.translation),
        "confidence": _finite(outcomes.confidence),
        "references_tried": outcomes.references.tolist(),
        "cam_from_world": [pose and _pose_to_json(pose) for pose in outcomes.cam_from_world],
        "seconds": outcomes.seconds.tolist(),
    }


def _pose_to_json(cam_from_world: pycolmap.Rigid3d) -> list[float]:
    return [*cam_from_world.rotation.quat.tolist(), *cam_from_world.translation.tolist()]


def _finite(values: np.ndarray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def digest_of(objects: Sequence[ObjectResult]) -> str:
    """Digest of maps and poses; it ignores times, paths, folders and what is only said about maps."""
    data = [_comparable(object_to_json(one)) for one in objects]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _comparable(value: Any) -> Any:
    if isinstance(value, dict):
        ignored = ("seconds", "images", "path", "quality", "notes", "skipped_queries", "contradicted_images")
        return {key: _comparable(one) for key, one in value.items() if key not in ignored}
    return [_comparable(one) for one in value] if isinstance(value, list) else value


def run_to_json(run: Run) -> dict:
    """The results of a run as plain values; `read_run` reads them."""
    return {
        "format": RESULT_FORMAT_VERSION,
        "digest": digest_of(run.objects),
        "dataset": run.dataset,
        "options": run.options,
        "environment": run.environment,
        "failed": run.failed,
        "objects": [object_to_json(one) for one in run.objects],
    }


def read_object_result(path: Path) -> ObjectResult:
    """Read the results of a finished object.

    Raises:
        InputError: The file is damaged.
    """
    with contents_of(path, _NO_RESULT, f"delete it and {_AGAIN}"):
        return object_from_json(read_json(path))


def read_run(folder: Path) -> Run:
    """Read a run.

    Args:
        folder: The folder of the run, or its results.json.

    Raises:
        InputError: The results are missing or damaged.
    """
    path = folder if folder.suffix == ".json" else folder / "results.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file; pass the folder of a run of slimsfm benchmark")
    with contents_of(path, _NO_RESULT, _AGAIN):
        data = read_json(path)
        if data["format"] != RESULT_FORMAT_VERSION:
            raise InputError(
                f"{path}: has format {data['format']!r}, expected {RESULT_FORMAT_VERSION}; {_AGAIN}"
            )
        objects = tuple(object_from_json(one) for one in data["objects"])
        if len({one.name for one in objects}) < len(objects):
            raise ValueError("an object occurs twice")
        return Run(
            folder=path.parent,
            dataset=plain(data["dataset"], str),
            options=_options_from_json(data["options"]),
            environment=plain(data["environment"], dict[str, str]),
            objects=objects,
            failed=plain(data["failed"], dict[str, str]),
        )


def _options_from_json(options: Any) -> dict:
    """Any plain values, but those that the reference graph depends on are of their types."""
    if not isinstance(options, dict):
        raise ValueError("the options are no table")
    json.dumps(options, allow_nan=False, ensure_ascii=False).encode()
    plain(options.get("command", ""), str)
    plain(options.get("edges", "localize"), Edges)
    threshold = plain(options.get("reduction", {}).get("threshold", 1.0), float)
    if threshold <= 0:
        raise ValueError(f"a threshold of {threshold}")
    return options


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """What the tables of a run show."""

    rows: tuple[Row, ...]
    """Rows of the table: averages first, then per object."""

    comparisons: tuple[Comparison, ...]
    """Comparison of every row with the full map."""

    dominating_sets: tuple[DominationSummary, ...]
    """Sizes of the dominating sets, per method."""


def write_results(run: Run) -> RunSummary:
    """Write results.json, the table as Markdown, LaTeX and CSV, and queries.csv into the folder of a run.

    Existing files are replaced.
    """
    rows, comparisons = all_rows(run), against_full(run.objects)
    dominating_sets = summarize_domination(run.objects)
    texts = {
        "table.md": markdown_page(run, rows, comparisons),
        "table.tex": latex_table(rows, run.dataset),
        "table.csv": csv_table(rows),
        "queries.csv": csv_queries(run.objects),
    }
    for name, text in texts.items():
        with replacing(run.folder / name, overwrite=True) as partial:
            partial.write_text(text, encoding="utf-8")
    data = run_to_json(run) | {
        "rows": [row.to_json() for row in rows],
        "comparisons": [one.to_json() for one in comparisons],
        "dominating_sets": [one.to_json() for one in dominating_sets],
    }
    write_json(run.folder / "results.json", data)
    return RunSummary(
        rows=tuple(rows), comparisons=tuple(comparisons), dominating_sets=tuple(dominating_sets)
    )
