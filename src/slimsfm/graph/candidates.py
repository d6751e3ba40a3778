"""Pairs of reference images that may localize each other; all other pairs can be skipped."""

import numpy as np
from jaxtyping import Bool, Float32, Int64
from scipy.sparse import triu

from slimsfm.geometry import project
from slimsfm.mapping.map import Map, observed

_GRID = 5  # samples along each edge of the box
_MAX_ANGLE_DEG = 75.0  # between viewing directions: no built-in extractor matches across more
_BLOCK = 1024  # images compared at once


def covisible_pairs(map: Map, min_points: int = 1) -> Int64[np.ndarray, "k 2"]:
    """Pairs (u, v), u < v, that see at least `min_points` common points; O(sum of squared track lengths)."""
    incidence = observed(map).astype(np.int32)
    common = triu(incidence @ incidence.T, k=1).tocoo()
    enough = common.data >= min_points
    return _sorted(np.stack([common.row[enough], common.col[enough]], axis=1).astype(np.int64))


def likely_pairs(map: Map) -> Int64[np.ndarray, "k 2"]:
    """Pairs that see a common point, or overlapping parts of the box from directions within 75 degrees.

    The box is sampled on a 5 x 5 x 5 grid. The direction of an image points from its camera to the mean of
    the samples it sees.
    """
    visible, directions = _views(map)
    least_cosine = np.cos(np.radians(_MAX_ANGLE_DEG))
    found = [covisible_pairs(map)]
    for start in range(0, len(visible), _BLOCK):
        block = slice(start, start + _BLOCK)
        meet = (visible[block] @ visible.T > 0) & (directions[block] @ directions.T >= least_cosine)
        rows, columns = np.nonzero(meet)
        found.append(np.stack([rows + start, columns], axis=1)[columns > rows + start])
    return _sorted(np.concatenate(found))


def all_pairs(map: Map) -> Int64[np.ndarray, "k 2"]:
    """All pairs (u, v), u < v."""
    return np.stack(np.triu_indices(len(map.images), k=1), axis=1).astype(np.int64)


def _views(map: Map) -> tuple[Float32[np.ndarray, "n s"], Float32[np.ndarray, "n 3"]]:
    """Which samples of the box each image sees, as 0 and 1, and its direction toward them (0 if none)."""
    steps = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    samples = map.box.center + grid @ map.box.half_edges
    visible = np.array([_inside(map, name, samples) for name in map.images])
    directions = np.zeros((len(visible), 3), np.float32)
    for row, image in enumerate(map.images.values()):
        if visible[row].any():
            towards = samples[visible[row]].mean(axis=0) - image.projection_center()
            directions[row] = towards / max(float(np.linalg.norm(towards)), 1e-12)
    return visible.astype(np.float32), directions


def _inside(map: Map, name: str, samples: np.ndarray) -> Bool[np.ndarray, " s"]:
    camera = map.camera(name)
    pixels = project(samples, map.images[name].cam_from_world(), camera)
    return np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)


def _sorted(pairs: Int64[np.ndarray, "k 2"]) -> Int64[np.ndarray, "_ 2"]:
    return np.unique(pairs, axis=0)
