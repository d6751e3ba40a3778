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
from slimsfm.evaluation.results import (
    MappedObject,
    MapRun,
    Measurement,
    ObjectResult,
    Outcomes,
    PosedQuery,
    Run,
)
from slimsfm.evaluation.table import Row, all_rows
from slimsfm.files import replacing
from slimsfm.geometry import Box
from slimsfm.mapping.quality import quality_from_json

RESULT_FORMAT_VERSION = 1

_DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError)


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
    }


def object_from_json(data: dict) -> ObjectResult:
    """The results of an object, from plain values.

    Raises:
        ValueError: The number of outcomes differs from the number of queries.
    """
    found = ObjectResult(
        name=data["name"],
        box=Box(**{key: np.array(values, np.float64) for key, values in data["box"].items()}),
        unit=data["unit"],
        images=Path(data["images"]),
        queries=tuple(_query_from_json(one) for one in data["queries"]),
        maps=tuple(_mapped_from_json(one) for one in data["maps"]),
        measurements=tuple(
            Measurement(
                method=one["method"],
                strategy=one["strategy"],
                variant=one["variant"],
                map_runs=tuple(_map_run_from_json(run) for run in one["trials"]),
            )
            for one in data["cells"]
        ),
        skipped=dict(data.get("skipped_queries", {})),
    )
    counts = {len(run.outcomes) for one in found.measurements for run in one.map_runs}
    if counts - {len(found.queries)}:
        raise ValueError(f"{len(found.queries)} queries, but {sorted(counts)} outcomes")
    return found


def _mapped_from_json(data: dict) -> MappedObject:
    """Results of earlier versions have neither quality nor notes."""
    return MappedObject(
        **{
            **data,
            "dominating_set": tuple(data["dominating_set"]),
            "quality": quality_from_json(data.get("quality")),
            "notes": tuple(data.get("notes", ())),
        }
    )


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


def _query_from_json(data: dict) -> PosedQuery:
    return PosedQuery(
        path=Path(data["path"]),
        camera=pycolmap.Camera(**data["camera"]),
        cam_from_world=_pose_from_json(data["cam_from_world"]),
        orientation=data.get("orientation", "upright"),
    )


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


def _map_run_from_json(data: dict) -> MapRun:
    return MapRun(
        references=data["references"],
        points=data["points"],
        map_bytes=data["map_bytes"],
        outcomes=Outcomes(
            error=_numbers(data["error"], np.inf),
            rotation_deg=_numbers(data["rotation_deg"], np.inf),
            translation=_numbers(data["translation"], np.inf),
            confidence=_numbers(data["confidence"], np.nan),
            references=np.array(data["references_tried"], np.int64),
            seconds=np.array(data["seconds"], np.float64).reshape(-1, 3),
            cam_from_world=tuple(
                None if pose is None else _pose_from_json(pose) for pose in data["cam_from_world"]
            ),
        ),
    )


def _pose_to_json(cam_from_world: pycolmap.Rigid3d) -> list[float]:
    return [*cam_from_world.rotation.quat.tolist(), *cam_from_world.translation.tolist()]


def _pose_from_json(numbers: list[float]) -> pycolmap.Rigid3d:
    x, y, z, w, *translation = numbers
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(translation))


def _finite(values: np.ndarray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _numbers(values: Sequence[float | None], missing: float) -> np.ndarray:
    return np.array([missing if value is None else value for value in values], np.float64)


def digest_of(objects: Sequence[ObjectResult]) -> str:
    """Digest of maps and poses; it ignores times, paths, folders and what is only said about maps."""
    data = [_comparable(object_to_json(one)) for one in objects]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _comparable(value: Any) -> Any:
    if isinstance(value, dict):
        ignored = ("seconds", "images", "path", "quality", "notes", "skipped_queries")
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
    try:
        return object_from_json(json.loads(path.read_text(encoding="utf-8")))
    except _DAMAGED as error:
        raise InputError(
            f"{path}: not a result of slimsfm benchmark ({error!r}); delete it and run the benchmark again"
        ) from error


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
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != RESULT_FORMAT_VERSION:
            raise InputError(
                f"{path}: has format {data['format']}, expected {RESULT_FORMAT_VERSION}; "
                "run the benchmark again"
            )
        return Run(
            folder=path.parent,
            dataset=data["dataset"],
            options=data["options"],
            environment=data["environment"],
            objects=tuple(object_from_json(one) for one in data["objects"]),
            failed=data["failed"],
        )
    except _DAMAGED as error:
        raise InputError(
            f"{path}: not a result of slimsfm benchmark ({error!r}); run the benchmark again"
        ) from error


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
