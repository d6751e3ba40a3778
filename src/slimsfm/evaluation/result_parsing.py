"""Results of an object from plain values, checked once, here, so that no table or page fails later."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.evaluation.results import MappedObject, MapRun, Measurement, ObjectResult, Outcomes, PosedQuery
from slimsfm.evaluation.variants import parse_variant
from slimsfm.files import inside, plain
from slimsfm.geometry import Box
from slimsfm.lenses import camera_fault
from slimsfm.photos import Orientation

_UNIT = 1e-6  # how far from 1 the length of a quaternion may be

Numbers = list[float | None]
Poses = list[list[float] | None]


def object_from_json(data: dict) -> ObjectResult:
    """The results of an object, from plain values.

    Raises:
        Exception: A value is missing, of another type or impossible, or a name would lead out of the folder
            of the run: parse inside `contents_of`.
    """
    found = ObjectResult(
        name=_folder_name(data["name"]),
        box=Box(_array(data["box"]["center"], 3), _array(data["box"]["half_edges"], 3, 3)),
        unit=plain(data["unit"], str),
        images=Path(plain(data["images"], str)),
        queries=tuple(_query_from_json(one) for one in data["queries"]),
        maps=tuple(_mapped_from_json(one) for one in data["maps"]),
        measurements=tuple(_measurement_from_json(one) for one in data["cells"]),
        skipped=plain(data.get("skipped_queries", {}), dict[str, str]),
        contradicted=plain(data.get("contradicted_images", {}), dict[str, str]),
    )
    _check(found)
    return found


def _check(found: ObjectResult) -> None:
    """Check that the parts of a result belong together."""
    if not found.queries or not found.measurements:
        raise ValueError(f"{found.name}: no query, or no measurement")
    counts = {len(run.outcomes) for one in found.measurements for run in one.map_runs}
    if counts != {len(found.queries)}:
        raise ValueError(f"{len(found.queries)} queries, but {sorted(counts)} outcomes")
    methods, mapped = [one.method for one in found.measurements], [one.method for one in found.maps]
    if set(methods) != set(mapped) or len(set(mapped)) < len(mapped):
        raise ValueError(f"maps of {mapped}, but measurements of {sorted(set(methods))}")
    if len({one.key for one in found.measurements}) < len(found.measurements):
        raise ValueError("a measurement occurs twice")


def _folder_name(value: Any) -> str:
    """A name that is that of a folder in the run."""
    name = plain(value, str)
    try:
        inside(Path("maps"), name)
    except InputError as error:
        raise ValueError(str(error)) from error
    return name


def _mapped_from_json(data: dict) -> MappedObject:
    """Results of earlier versions have neither quality nor notes."""
    if unknown := set(data).difference(one.name for one in fields(MappedObject)):
        raise ValueError(f"{min(unknown)!r} is unknown")
    mapped = plain(data, MappedObject)
    _folder_name(mapped.method)
    if not 0 < len(mapped.dominating_set) <= mapped.references or mapped.points < 1:
        raise ValueError(
            f"{len(mapped.dominating_set)} of {mapped.references} images and {mapped.points} points"
        )
    return mapped


def _query_from_json(data: dict) -> PosedQuery:
    camera = pycolmap.Camera(
        model=plain(data["camera"]["model"], str),
        width=plain(data["camera"]["width"], int),
        height=plain(data["camera"]["height"], int),
        params=plain(data["camera"]["params"], list[float]),
    )
    if fault := camera_fault(camera):
        raise ValueError(f"an impossible camera: {fault}")
    return PosedQuery(
        path=Path(plain(data["path"], str)),
        camera=camera,
        cam_from_world=_pose_from_json(data["cam_from_world"]),
        orientation=plain(data.get("orientation", "upright"), Orientation),
    )


def _measurement_from_json(data: dict) -> Measurement:
    variant = plain(data["variant"], str)
    parse_variant(variant)
    runs = tuple(_map_run_from_json(run) for run in data["trials"])
    if not runs:
        raise ValueError(f"no measurement of {variant}")
    return Measurement(
        method=plain(data["method"], str),
        strategy=plain(data["strategy"], str),
        variant=variant,
        map_runs=runs,
    )


def _map_run_from_json(data: dict) -> MapRun:
    counts = [plain(data[key], int) for key in ("references", "points", "map_bytes")]
    if min(counts) < 1:
        raise ValueError(f"a map of {counts[0]} images, {counts[1]} points and {counts[2]} bytes")
    return MapRun(
        references=counts[0], points=counts[1], map_bytes=counts[2], outcomes=_outcomes_from_json(data)
    )


def _outcomes_from_json(data: dict) -> Outcomes:
    outcomes = Outcomes(
        error=_numbers(data["error"], np.inf),
        rotation_deg=_numbers(data["rotation_deg"], np.inf),
        translation=_numbers(data["translation"], np.inf),
        confidence=_numbers(data["confidence"], np.nan),
        references=np.array(plain(data["references_tried"], list[int]), np.int64),
        seconds=np.array(plain(data["seconds"], list[list[float]]), np.float64).reshape(-1, 3),
        cam_from_world=tuple(
            None if pose is None else _pose_from_json(pose) for pose in data["cam_from_world"]
        ),
    )
    lost = np.array([pose is None for pose in outcomes.cam_from_world], bool)
    for values in (outcomes.error, outcomes.rotation_deg, outcomes.translation):
        if not np.array_equal(np.isinf(values), lost) or (values < 0).any():
            raise ValueError("errors that are negative, or do not belong to the poses")
    if (outcomes.seconds < 0).any() or not (outcomes.seconds[:, 1:].sum(axis=1) > 0).all():
        raise ValueError("times that are not positive")
    if (outcomes.confidence < 0).any() or (outcomes.confidence > 1).any() or (outcomes.references < 0).any():
        raise ValueError("confidences that are no probabilities, or negative numbers of references")
    return outcomes


def _pose_from_json(numbers: Any) -> pycolmap.Rigid3d:
    values = _array(numbers, 7)
    if abs(np.linalg.norm(values[:4]) - 1) > _UNIT:
        raise ValueError(f"{values[:4].tolist()} is not the quaternion of a rotation")
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[:4]), values[4:])


def _array(values: Any, *shape: int) -> Float64[np.ndarray, "..."]:
    kind = list[list[float]] if len(shape) > 1 else list[float]
    return np.array(plain(values, kind), np.float64).reshape(shape)


def _numbers(values: Any, missing: float) -> Float64[np.ndarray, " n"]:
    return np.array([missing if one is None else one for one in plain(values, Numbers)], np.float64)
