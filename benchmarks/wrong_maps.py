"""Maps with wrong poses, made of right ones."""

import tempfile
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.cli.output import quiet
from slimsfm.geometry import corner_error
from slimsfm.mapping import Map
from slimsfm.mapping.scratch import write_database, write_geometries
from slimsfm.mapping.sfm import triangulate

FROM_DEG, TO_DEG = 5.0, 60.0
"""By how much moved images are turned around the middle of the box."""

_LEAST = 0.05  # relative corner error from which a pose is wrong: it would not count as localized

Poses = Mapping[str, pycolmap.Rigid3d]


@dataclass(frozen=True, kw_only=True)
class WrongMap:
    """A map with wrong poses."""

    map: Map
    """The map."""

    wrong: frozenset[str]
    """The images whose poses are wrong."""


def poses_of(map: Map) -> dict[str, pycolmap.Rigid3d]:
    """The poses of a map by name."""
    return {name: image.cam_from_world() for name, image in map.images.items()}


def made_wrong(map: Map, count: int, *, retriangulate: bool, seed: int) -> WrongMap:
    """Make poses wrong.

    Of each three images, one is moved, one has the pose of another, and one stands at its twin position.

    Args:
        map: A right map with matches.
        count: How many.
        retriangulate: Triangulate all matches with the wrong poses, as from wrong annotations. Otherwise
            points and tracks stay as they are.
        seed: Seed of the choice.
    """
    rng, right = np.random.default_rng(seed), poses_of(map)
    poses, wrong = dict(right), []
    for name in rng.permutation(list(right)).tolist():
        if len(wrong) == count:
            break
        pose = next(
            one
            for one in _candidates(map, right, name, len(wrong) % 3, rng)
            if corner_error(one, right[name], map.box) >= _LEAST
        )
        poses[name] = pose
        wrong.append(name)
    made = retriangulated(map, poses) if retriangulate else with_poses(map, poses)
    return WrongMap(map=made, wrong=frozenset(wrong))


def _candidates(
    map: Map, right: Poses, name: str, kind: int, rng: np.random.Generator
) -> Iterator[pycolmap.Rigid3d]:
    while True:
        axis = rng.normal(size=3)
        if kind == 0:
            yield right[name] * _turn(map, axis, rng.uniform(FROM_DEG, TO_DEG))
        elif kind == 1:
            yield right[rng.choice([other for other in right if other != name])]
        else:  # half a turn around the vertical, as the two equal sides of an object are apart
            down = np.mean([pose.rotation.matrix()[1] for pose in right.values()], axis=0)
            yield right[name] * _turn(map, down, 180.0)


def _turn(map: Map, axis: np.ndarray, angle_deg: float) -> pycolmap.Rigid3d:
    """A rotation around an axis through the middle of the box."""
    rotation = pycolmap.Rotation3d(axis / np.linalg.norm(axis) * np.radians(angle_deg))
    return pycolmap.Rigid3d(rotation, map.box.center - rotation.matrix() @ map.box.center)


def with_poses(map: Map, poses: Poses) -> Map:
    """The map with other poses; points and tracks stay."""
    model = pycolmap.Reconstruction(map.model)
    for name, pose in poses.items():
        model.frame(map.images[name].frame_id).rig_from_world = pose
    return replace(map, model=model)


def retriangulated(map: Map, poses: Poses) -> Map:
    """The map that `build` would have made of the same matches with these known poses."""
    names, cameras = list(map.images), {}
    for name in names:
        cameras[name] = copy(map.camera(name))
        cameras[name].camera_id = map.images[name].camera_id
    geometries = {}
    for pair in map.matches:
        geometries[pair] = pycolmap.TwoViewGeometry()
        geometries[pair].config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometries[pair].inlier_matches = map.matches[pair].astype(np.uint32)
    with tempfile.TemporaryDirectory() as folder, quiet():
        database = Path(folder) / "database.db"
        write_database(database, {name: map.features[name] for name in names}, cameras)
        write_geometries(database, names, geometries)
        model = triangulate(database, names, Path(folder) / "sfm", poses, seed=0)
    return replace(map, model=model)
