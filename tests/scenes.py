"""A tiny exact scene: points on and in a box, cameras around it, keypoints where the points project."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.features import Features
from slimsfm.geometry import Box, project
from slimsfm.graph import GraphOptions, ReferenceGraph, compute_graph
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.synthetic.scene import look_at

BOX = Box(np.zeros(3), np.diag([1.0, 0.8, 0.6]))
ALGORITHM_1 = GraphOptions(edges="localize", candidates="all")  # as the paper states it


def camera(model: str = "OPENCV") -> pycolmap.Camera:
    made = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    if model == "OPENCV":
        made.params = np.array([500.0, 505.0, 322.0, 238.0, -0.08, 0.02, 0.001, -0.001])
    return made


def poses(count: int) -> list[pycolmap.Rigid3d]:
    """Cameras on a ring around the box, alternately low and high."""
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [np.array([5 * np.cos(a), 5 * np.sin(a), 1.5 + (i % 2)]) for i, a in enumerate(angles)]
    return [look_at(eye, np.zeros(3)) for eye in eyes]


def exact_map(num_images: int = 6, num_points: int = 120, seed: int = 0, reach_deg: float = 180.0) -> Map:
    """A map without any error, whose points are seen by cameras within `reach_deg` of their direction.

    Each point has a descriptor of its own, equal in every image; each image has 20 more keypoints that see
    nothing.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (num_points, 3)) @ BOX.half_edges
    descriptors = _unit(rng.normal(size=(num_points, 32)))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera())
    features, seen_by = {}, {i: pycolmap.Track() for i in range(num_points)}
    for image_id, cam_from_world in enumerate(poses(num_images), start=1):
        eye = cam_from_world.inverse().translation
        cosines = (points @ eye) / (np.linalg.norm(points, axis=1) * np.linalg.norm(eye))
        seen = np.flatnonzero(cosines >= np.cos(np.radians(reach_deg)))
        keypoints = np.concatenate(
            [project(points[seen], cam_from_world, camera()), rng.uniform(10, 470, (20, 2))]
        )
        name = f"{image_id:03d}.png"
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, cam_from_world)
        for row, point in enumerate(seen):
            seen_by[int(point)].add_element(image_id, row)
        features[name] = Features(
            keypoints=keypoints.astype(np.float32),
            descriptors=np.concatenate([descriptors[seen], _unit(rng.normal(size=(20, 32)))]).astype(
                np.float32
            ),
            scores=np.ones(len(keypoints), np.float32),
            image_size=(640, 480),
        )
    for point, track in seen_by.items():
        if track.length() >= 2:
            model.add_point3D(points[point], track, np.array([200, 100, 50], np.uint8))
    info = MapInfo(extractor="sift", box=BOX, box_source="given", unit="metre", origin="made by the tests")
    return Map(model=model, features=features, info=info)


def with_matches(map_: Map) -> Map:
    """The same map with the matches between consecutive images that its tracks imply."""
    names = list(map_.images)
    matches = {}
    for a, b in pairwise(names):
        of_a, of_b = map_.observations[a], map_.observations[b]
        _, rows_a, rows_b = np.intersect1d(of_a.points, of_b.points, return_indices=True)
        pairs = np.stack([of_a.rows[rows_a], of_b.rows[rows_b]], axis=1)
        matches[a, b] = pairs[np.argsort(pairs[:, 0])]
    return replace(map_, matches=matches)


def with_shuffled_points(map_: Map) -> Map:
    """The same map, changed in place, with each point where another was: no pose agrees with its matches."""
    points = [map_.model.point3D(i) for i in sorted(map_.model.point3D_ids())]
    places = np.random.default_rng(0).permutation([point.xyz for point in points])
    for point, xyz in zip(points, places, strict=True):
        point.xyz = xyz
    return map_


def graph_from_dense(names: tuple[str, ...], errors: np.ndarray) -> ReferenceGraph:
    """The graph with these errors on all pairs of two different images."""
    pairs = np.argwhere(~np.eye(len(names), dtype=bool))
    return ReferenceGraph.from_errors(names, pairs, errors[pairs[:, 0], pairs[:, 1]])


def algorithm_1(map_: Map) -> ReferenceGraph:
    """The reference graph by the paper's Algorithm 1."""
    return compute_graph(map_, ALGORITHM_1).graph


def like_sift(map_: Map) -> Map:
    """The same map with descriptors that could be SIFT's: 128 bytes. Those of a point stay equal."""

    def changed(features: Features) -> Features:
        signed = np.pad(features.descriptors, ((0, 0), (0, 64 - features.descriptors.shape[1])))
        parts = np.concatenate([np.maximum(signed, 0), np.maximum(-signed, 0)], axis=1)
        return replace(features, descriptors=np.round(255 * parts).astype(np.uint8))

    return replace(map_, features={name: changed(one) for name, one in map_.features.items()})


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def without_checksums(map_path: Path) -> None:
    """Make a map on disk an older one, in which damage is not found by checksums."""
    path = map_path / "map.json"
    data = json.loads(path.read_text())
    del data["checksums"]
    path.write_text(json.dumps(data))
