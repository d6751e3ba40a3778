"""Results of benchmarks on disk: one JSON file an object, and one for the whole run.

A pose is seven numbers, the quaternion x y z w of its rotation and its translation, so that what is read is
to the bit what was written.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from slimsfm.errors import InputError
from slimsfm.evaluation.outcomes import Outcomes
from slimsfm.evaluation.protocol import Query
from slimsfm.evaluation.results import Cell, MappedObject, ObjectResult, Run, Trial
from slimsfm.files import replacing
from slimsfm.geometry import Box

FORMAT_VERSION = 1

_DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError)


def write_json(path: Path, data: dict) -> None:
    """Write a JSON file, replacing what stood there; no number may be infinite, and paths become text."""
    with replacing(path, overwrite=True) as partial:
        partial.write_text(json.dumps(data, indent=1, allow_nan=False, default=str) + "\n", encoding="utf-8")


def object_to_json(result: ObjectResult) -> dict:
    """The result of an object as plain values."""
    return {
        "name": result.name,
        "box": {"center": result.box.center.tolist(), "half_edges": result.box.half_edges.tolist()},
        "unit": result.unit,
        "images": str(result.images),
        "queries": [_query_to_json(query) for query in result.queries],
        "maps": [asdict(one) for one in result.maps],
        "cells": [
            {
                "method": cell.method,
                "strategy": cell.strategy,
                "variant": cell.variant,
                "trials": [_trial_to_json(trial) for trial in cell.trials],
            }
            for cell in result.cells
        ],
    }


def object_from_json(data: dict) -> ObjectResult:
    """The result of an object, from plain values.

    Raises:
        ValueError: There is not one outcome a query.
    """
    found = ObjectResult(
        name=data["name"],
        box=Box(**{key: np.array(values, np.float64) for key, values in data["box"].items()}),
        unit=data["unit"],
        images=Path(data["images"]),
        queries=tuple(_query_from_json(one) for one in data["queries"]),
        maps=tuple(
            MappedObject(**{**one, "dominating_set": tuple(one["dominating_set"])}) for one in data["maps"]
        ),
        cells=tuple(
            Cell(
                method=cell["method"],
                strategy=cell["strategy"],
                variant=cell["variant"],
                trials=tuple(_trial_from_json(trial) for trial in cell["trials"]),
            )
            for cell in data["cells"]
        ),
    )
    counts = {len(trial.outcomes) for cell in found.cells for trial in cell.trials}
    if counts - {len(found.queries)}:
        raise ValueError(f"there are {len(found.queries)} queries, but outcomes of {sorted(counts)}")
    return found


def _query_to_json(query: Query) -> dict:
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
    }


def _query_from_json(data: dict) -> Query:
    return Query(
        path=Path(data["path"]),
        camera=pycolmap.Camera(**data["camera"]),
        cam_from_world=_pose_from_json(data["cam_from_world"]),
    )


def _trial_to_json(trial: Trial) -> dict:
    outcomes = trial.outcomes
    return {
        "references": trial.references,
        "points": trial.points,
        "map_bytes": trial.map_bytes,
        "error": _finite(outcomes.error),
        "rotation_deg": _finite(outcomes.rotation_deg),
        "translation": _finite(outcomes.translation),
        "confidence": _finite(outcomes.confidence),
        "references_tried": outcomes.references.tolist(),
        "cam_from_world": [pose and _pose_to_json(pose) for pose in outcomes.cam_from_world],
        "seconds": outcomes.seconds.tolist(),
    }


def _trial_from_json(data: dict) -> Trial:
    return Trial(
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
    """Equal for runs that found the same poses with the same maps, whatever time it took and where."""
    data = [_without_time(object_to_json(one)) for one in objects]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _without_time(value: Any) -> Any:
    if isinstance(value, dict):
        left_out = ("seconds", "images", "path")
        return {key: _without_time(one) for key, one in value.items() if key not in left_out}
    return [_without_time(one) for one in value] if isinstance(value, list) else value


def run_to_json(run: Run) -> dict:
    """What a run measured, as plain values; `read_run` reads it back."""
    return {
        "format": FORMAT_VERSION,
        "digest": digest_of(run.objects),
        "dataset": run.dataset,
        "options": run.options,
        "environment": run.environment,
        "failed": run.failed,
        "objects": [object_to_json(one) for one in run.objects],
    }


def read_object_result(path: Path) -> ObjectResult:
    """Read the result of an object that is done.

    Raises:
        InputError: It is damaged.
    """
    try:
        return object_from_json(json.loads(path.read_text(encoding="utf-8")))
    except _DAMAGED as error:
        raise InputError(
            f"{path}: is no result of slimsfm benchmark ({error!r}); delete it and run it again"
        ) from error


def read_run(folder: Path) -> Run:
    """Read a run.

    Args:
        folder: Its folder, or the results.json in it.

    Raises:
        InputError: There is no result, or it is damaged.
    """
    path = folder if folder.suffix == ".json" else folder / "results.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the folder of a run of slimsfm benchmark")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT_VERSION:
            raise InputError(
                f"{path}: is of format {data['format']}, this reads {FORMAT_VERSION}; run it again"
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
        raise InputError(f"{path}: is no result of slimsfm benchmark ({error!r}); run it again") from error
