"""The paper's Algorithm 1: localize every reference image from every other one.

References:
    Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Int64

from slimsfm.arrays import Descriptors, Points2D
from slimsfm.features import NearestOptions, match_nearest, unit_rows
from slimsfm.geometry import corner_error
from slimsfm.graph.reference_graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.pose import RansacOptions, estimate_pose
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True)
class GraphOptions:
    """How one reference image is localized from another."""

    matching: NearestOptions = NearestOptions()
    """Which keypoints match."""

    ransac: RansacOptions = RansacOptions()
    """The pose search."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Reference:
    """A reference image in both its roles."""

    keypoints: Points2D
    descriptors: Descriptors
    rows: Int64[np.ndarray, " k"]  # of those keypoints that see a point
    points: Int64[np.ndarray, " k"]  # rows of these points
    camera: pycolmap.Camera
    cam_from_world: pycolmap.Rigid3d


def localize_pairs(
    map: Map, options: GraphOptions = GraphOptions(), progress: ProgressBar = silent
) -> ReferenceGraph:
    """Localize every reference image from every other one alone.

    For the pair (u, v) the keypoints of v are matched against the points that u sees, each described as u
    sees it; the pose of v estimated from these matches is compared with its pose in the map.

    Complexity: n (n - 1) matchings of all keypoints with the points of one image.
    """
    references = [_reference(map, name) for name in map.images]
    errors = np.full((len(references), len(references)), np.inf)
    np.fill_diagonal(errors, 0.0)
    for u in progress(range(len(references)), "localize references from each other"):
        for v in range(len(references)):
            if u != v:
                errors[u, v] = _error(map, references[u], references[v], options)
    return ReferenceGraph(names=tuple(map.images), errors=errors)


def _reference(map: Map, name: str) -> _Reference:
    image, features, seen = map.images[name], map.features[name], map.observations[name]
    return _Reference(
        keypoints=features.keypoints.astype(np.float64),
        descriptors=unit_rows(features.descriptors),
        rows=seen.rows,
        points=seen.points,
        camera=map.camera(name),
        cam_from_world=image.cam_from_world(),
    )


def _error(map: Map, reference: _Reference, query: _Reference, options: GraphOptions) -> float:
    """Relative corner error of the query's pose estimated from the reference; infinite without a pose."""
    pairs = match_nearest(query.descriptors, reference.descriptors[reference.rows], options.matching)
    pose = estimate_pose(
        query.keypoints[pairs[:, 0]],
        map.points3D_in_world[reference.points[pairs[:, 1]]],
        query.camera,
        options.ransac,
    )
    return np.inf if pose is None else corner_error(pose.cam_from_world, query.cam_from_world, map.box)
