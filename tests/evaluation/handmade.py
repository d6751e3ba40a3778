"""Handmade results as input for tests."""

from pathlib import Path

import numpy as np
import pycolmap

from scenes import BOX
from slimsfm.evaluation.results import (
    MappedObject,
    MapRun,
    Measurement,
    ObjectResult,
    Outcomes,
    PosedQuery,
    Run,
)

FULL, DOMINATING = ("sift", "exhaustive", "full"), ("sift", "exhaustive", "dominating")


def rigid(axis=(0.0, 0.0, 1.0), angle_deg=0.0, translation=(0.0, 0.0, 0.0)):
    half = np.radians(angle_deg) / 2
    quaternion = [*(np.sin(half) * np.array(axis) / np.linalg.norm(axis)), np.cos(half)]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(quaternion)), np.array(translation, np.float64))


def random_pose(rng):
    quaternion = rng.normal(size=4)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), rng.normal(size=3))


def outcomes_like(errors, *, confidence=0.95, references=3, seconds=(0.01, 0.02, 0.005)):
    """Outcomes with these relative errors, also as meters, and times 100 as degrees."""
    errors = np.array(errors, np.float64)
    found = np.isfinite(errors)
    return Outcomes(
        error=errors,
        rotation_deg=100 * errors,
        translation=errors,
        confidence=np.where(found, confidence, np.nan),
        references=np.full(len(errors), references),
        seconds=np.tile(np.array(seconds, np.float64), (len(errors), 1)),
        cam_from_world=tuple(rigid(translation=(0, 0, one)) if np.isfinite(one) else None for one in errors),
    )


def map_run_like(errors, *, references=4, points=100, map_bytes=1000, **how):
    outcomes = outcomes_like(errors, **how)
    return MapRun(references=references, points=points, map_bytes=map_bytes, outcomes=outcomes)


def measurement_like(key, *draws, **how):
    """One measurement; each draw is a list of errors."""
    method, strategy, variant = key
    trials = tuple(map_run_like(errors, **how) for errors in draws)
    return Measurement(method=method, strategy=strategy, variant=variant, map_runs=trials)


def result_like(name, *cells, unit="metre", queries=None):
    """An object with these measurements."""
    count = len(cells[0].map_runs[0].outcomes)
    names = queries or [f"{number}.png" for number in range(count)]
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)
    return ObjectResult(
        name=name,
        box=BOX,
        unit=unit,
        images=Path("photos"),
        queries=tuple(
            PosedQuery(path=Path("queries", one), camera=camera, cam_from_world=rigid()) for one in names
        ),
        maps=(mapped_like("sift"),),
        measurements=cells,
    )


def mapped_like(method, *, references=10, chosen=2, points=100, dominating_points=40):
    return MappedObject(
        method=method,
        references=references,
        points=points,
        edges=30,
        dominating_set=tuple(f"{number}.png" for number in range(chosen)),
        lower_bound=chosen,
        dominating_points=dominating_points,
    )


def run_like(*objects, folder=Path("run"), failed=None):
    return Run(
        folder=folder,
        dataset="TinyDataset toys",
        options={"variants": ["full", "dominating"]},
        environment={"cpu": "abacus", "python": "3.99"},
        objects=objects,
        failed=failed or {},
    )
