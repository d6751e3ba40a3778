from dataclasses import replace

import cv2
import numpy as np
import pytest

from scenes import ALGORITHM_1, algorithm_1, exact_map, graph_from_dense
from slimsfm.features import unit_rows
from slimsfm.geometry import corner_error
from slimsfm.graph import GraphWork, compute_graph
from slimsfm.mapping.subset import keep_images
from slimsfm.pose import RansacOptions

EXACT = 1e-4


def shared_points(map_):
    """[u, v]: how many points of the map both images see."""
    seen = [set(one.points.tolist()) for one in map_.observations.values()]
    return np.array([[len(a & b) for b in seen] for a in seen])


def test_where_everything_is_seen_everything_is_localized_without_error(exact):
    graph = algorithm_1(exact)
    assert graph.names == tuple(exact.images)
    assert graph.dense().max() < EXACT
    assert np.array_equal(np.diag(graph.dense()), np.zeros(6))
    assert graph.num_edges() == 6 * 5


@pytest.mark.parametrize("reach_deg", [50.0, 65.0, 80.0])
def test_an_edge_is_where_enough_points_are_shared(reach_deg):
    map_ = exact_map(num_images=8, reach_deg=reach_deg)
    expected = shared_points(map_) >= RansacOptions().min_inliers
    np.fill_diagonal(expected, False)
    graph = algorithm_1(map_)
    assert 0 < expected.sum() < 56
    assert np.array_equal(graph.adjacency().toarray(), expected)
    assert graph.dense()[expected].max() < EXACT
    assert np.all(np.isinf(graph.dense()[~expected & ~np.eye(8, dtype=bool)]))


def test_an_edge_has_a_direction():
    """Two images match equally well either way; only the one that sees points localizes the other."""
    map_ = exact_map(num_images=3)
    seer, blind, _ = map_.images
    image_id = map_.images[blind].image_id
    for row in map_.images[blind].get_observation_point2D_idxs():
        map_.model.delete_observation(image_id, row)
    assert len(map_.observations[blind].rows) == 0
    graph = algorithm_1(map_)
    errors = dict(zip(graph.names, graph.dense(), strict=True))
    assert errors[seer][1] < EXACT
    assert np.isinf(errors[blind][0])


def test_a_graph_of_some_images_is_that_part_of_the_graph_of_all():
    map_ = exact_map(num_images=8, reach_deg=80.0)
    kept = [1, 2, 4, 7]
    names = list(map_.images)
    part = algorithm_1(keep_images(map_, [names[i] for i in kept]))
    assert np.array_equal(part.dense(), algorithm_1(map_).dense()[np.ix_(kept, kept)])


def test_the_options_reach_the_pose_search():
    map_ = exact_map(num_images=8, reach_deg=65.0)
    counts = shared_points(map_)
    needed = int(np.median(counts))
    graph = compute_graph(map_, replace(ALGORITHM_1, ransac=RansacOptions(min_inliers=needed))).graph
    expected = (counts >= needed) & ~np.eye(8, dtype=bool)
    assert np.array_equal(graph.adjacency().toarray(), expected)


def test_a_threshold_is_exclusive_and_changes_only_the_decisions():
    errors = np.array([[0.0, 0.05, 0.02], [np.inf, 0.0, 0.0499], [0.3, 0.06, 0.0]])
    graph = graph_from_dense(("a", "b", "c"), errors)
    assert graph.adjacency().toarray().tolist() == [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    assert [graph.num_edges(t) for t in (0.01, 0.02, 0.03, 0.05, 0.051, 0.1, 1.0)] == [0, 0, 1, 2, 3, 4, 5]


def test_progress_sees_each_block_of_work(exact):
    seen = []

    def watch(items, label):
        for item in items:
            seen.append(label)
            yield item

    compute_graph(exact, ALGORITHM_1, GraphWork(block_seconds=0.0), progress=watch)  # blocks of one pair
    untimed = 6 * 5 // 2 - TIMED_PAIRS
    assert seen == [f"localize {untimed} pairs from each other, 1 at a time"] * untimed


TIMED_PAIRS = 8  # localized first, to choose the size of the blocks


def opencv_matches(query, reference):
    """Mutual nearest neighbors that pass Lowe's ratio test, by OpenCV's matcher."""
    angle = lambda match: 2 * np.arcsin(min(1.0, match.distance / 2))  # noqa: E731
    mutual = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(query, reference)
    mutual = {(match.queryIdx, match.trainIdx) for match in mutual}
    return [
        (best.queryIdx, best.trainIdx)
        for best, second in cv2.BFMatcher(cv2.NORM_L2).knnMatch(query, reference, k=2)
        if (best.queryIdx, best.trainIdx) in mutual
        and angle(best) <= 0.8 * angle(second)
        and angle(best) <= 0.7
    ]


def opencv_pose(points2D, points3D, matrix):
    """Rotation and translation by OpenCV, refined over the inliers; None with fewer than 12 of them."""
    if len(points2D) < 12:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points3D, points2D, matrix, None, iterationsCount=1000, reprojectionError=6.0, flags=cv2.SOLVEPNP_AP3P
    )
    if not found or len(inliers) < 12:
        return None
    rows = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(
        points3D[rows], points2D[rows], matrix, None, rotation, translation
    )
    return cv2.Rodrigues(rotation)[0], translation.ravel()


def opencv_error(map_, u, v):
    """Relative corner error of v from u, with nothing of this package but the map's content."""
    of_u, of_v, seen = map_.features[u], map_.features[v], map_.observations[u]
    matches = opencv_matches(unit_rows(of_v.descriptors), unit_rows(of_u.descriptors[seen.rows]))
    if len(matches) < 12:
        return np.inf
    rows, columns = np.array(matches).T
    matrix = map_.shared_camera.calibration_matrix()
    pose = opencv_pose(
        of_v.keypoints[rows].astype(np.float64), map_.points3D_in_world[seen.points[columns]], matrix
    )
    if pose is None:
        return np.inf
    rotation, translation = pose
    truth = map_.images[v].cam_from_world().matrix()
    corners = map_.box.corners
    moved = (corners @ rotation.T + translation) - (corners @ truth[:, :3].T + truth[:, 3])
    diagonal = max(np.linalg.norm(corners - corner, axis=1).max() for corner in corners)
    return np.mean(np.sqrt(np.sum(moved**2, axis=1))) / diagonal


def test_decisions_agree_with_an_independent_computation_by_opencv(boulder):
    """97.7 % of the 870 ordered pairs of a rendered object's images: 420 edges here, 414 by OpenCV.

    Where few matches agree, a wrong one among them moves OpenCV's least squares more than the loss here.
    """
    map_ = boulder.map
    names = list(map_.images)
    assert map_.shared_camera.model_name == "PINHOLE"
    graph = algorithm_1(map_)
    errors = np.array([[0.0 if u == v else opencv_error(map_, u, v) for v in names] for u in names])
    off_diagonal = ~np.eye(len(names), dtype=bool)
    agree = (graph.adjacency().toarray() == (errors < 0.05))[off_diagonal]
    assert graph.num_edges() > 100
    assert agree.mean() >= 0.97


def test_corner_errors_are_those_computed_by_hand(exact):
    a, b = (image.cam_from_world() for image in list(exact.images.values())[:2])
    corners = exact.box.corners
    by_hand = [
        np.linalg.norm(
            (a.matrix()[:, :3] @ corner + a.matrix()[:, 3]) - (b.matrix()[:, :3] @ corner + b.matrix()[:, 3])
        )
        for corner in corners
    ]
    diagonal = 2 * np.linalg.norm([1.0, 0.8, 0.6])
    assert corner_error(a, b, exact.box) == pytest.approx(np.mean(by_hand) / diagonal, rel=1e-12)
