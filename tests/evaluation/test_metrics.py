from dataclasses import replace
from itertools import combinations

import numpy as np
import pycolmap
import pytest
from handmade import random_pose, rigid

from scenes import BOX
from slimsfm.datasets.base import ObjectModel
from slimsfm.evaluation.results import NO_POSE, PoseError, model_error, pose_error
from slimsfm.evaluation.scores import add_percent, deg_cm_percent, within_deg_cm, wrong_when_sure
from slimsfm.geometry import Box

DIAGONAL = 2 * np.sqrt(1.0**2 + 0.8**2 + 0.6**2)
PILLAR = np.array([[1, 2, 0], [-1, -2, 0], [2, -1, 3], [-2, 1, 3], [0, 0, 5], [0, 0, -5]], np.float64)
"""Vertices that are invariant under half a turn about z."""


def model_of(vertices, *, symmetric=False, diameter=10.0):
    return ObjectModel(vertices=np.array(vertices, np.float64), diameter=diameter, symmetric=symmetric)


# The published formulas in their usual form.


def angle_by_trace(a, b):
    """The arc cosine of the trace, clipped against rounding."""
    trace = np.trace(a.rotation.matrix() @ b.rotation.matrix().T)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def moved(pose, points):
    return points @ pose.rotation.matrix().T + pose.translation


def add_by_hand(estimated, true, points):
    return np.mean(np.sqrt(np.sum((moved(estimated, points) - moved(true, points)) ** 2, axis=1)))


def adds_by_hand(estimated, true, points):
    """Mean over true points of the smallest distance to any estimated point."""
    offsets = moved(true, points)[:, None] - moved(estimated, points)[None]
    return np.mean(np.min(np.sqrt(np.sum(offsets**2, axis=2)), axis=1))


def test_errors_agree_with_the_published_formulas_on_a_thousand_poses():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-1, 1, (20, 3))
    asymmetric, symmetric = (model_of(vertices, symmetric=one, diameter=2.5) for one in (False, True))
    compared = 0
    for number in range(1000):
        true = random_pose(rng)
        # every second estimate is close to the truth
        estimated = random_pose(rng) if number % 2 else near(true, rng)
        found = pose_error(estimated, true, BOX)
        angle = angle_by_trace(estimated, true)
        if 1 < angle < 179:
            compared += 1
            assert abs(found.rotation_deg - angle) < 1e-9
        offset = estimated.translation - true.translation
        assert_close(found.translation, np.sqrt(offset @ offset))
        assert_close(found.relative, add_by_hand(estimated, true, BOX.corners) / DIAGONAL)
        by_vertices = pose_error(estimated, true, BOX, asymmetric)
        assert by_vertices == replace(found, relative=by_vertices.relative)
        assert_close(by_vertices.relative, add_by_hand(estimated, true, vertices) / 2.5)
        nearest = pose_error(estimated, true, BOX, symmetric).relative
        assert_close(nearest, adds_by_hand(estimated, true, vertices) / 2.5)
        assert nearest <= by_vertices.relative * (1 + 1e-12)
    assert compared > 900


def assert_close(found, expected):
    assert abs(found - expected) <= 1e-10 * expected


def near(pose, rng):
    return rigid(rng.normal(size=3), rng.uniform(0, 10), rng.normal(scale=0.03, size=3)) * pose


def test_equal_poses_have_no_error():
    pose = rigid((1, 2, 3), 77.0, (1, -2, 3))
    assert pose_error(pose, pose, BOX) == PoseError(relative=0.0, rotation_deg=0.0, translation=0.0)
    assert pose_error(pose, pose, BOX, model_of(PILLAR, symmetric=True)).relative == 0.0


def test_a_shift_moves_every_corner_by_its_length():
    found = pose_error(rigid(translation=(0.03, 0.04, 0.0)), rigid(), BOX)
    assert found.relative == pytest.approx(0.05 / DIAGONAL)
    assert found.translation == pytest.approx(0.05)
    assert found.rotation_deg == 0.0


@pytest.mark.parametrize("angle_deg", [1e-6, 0.5, 10.0, 90.0, 179.999, 180.0])
def test_a_turn_about_z_moves_every_corner_along_its_chord(angle_deg):
    """All corners are equally far from the axis; a chord is twice that radius times the half angle's sine."""
    found = pose_error(rigid(angle_deg=angle_deg), rigid(), BOX)
    chord = 2 * np.hypot(1.0, 0.8) * np.sin(np.radians(angle_deg) / 2)
    assert found.relative == pytest.approx(chord / DIAGONAL, rel=1e-6)
    assert found.rotation_deg == pytest.approx(angle_deg, rel=1e-6)
    assert found.translation == 0.0


@pytest.mark.parametrize("angle", [1e-8, 1e-7, np.pi - 1e-7, np.pi - 1e-8], ids=str)
def test_angles_near_0_and_180_degrees_are_accurate_to_a_billionth_of_a_radian(angle):
    """There the cosine is flat, so the formula with the trace loses half of the digits."""
    rng = np.random.default_rng(1)
    ours, by_trace = [], []
    for _ in range(50):
        true = random_pose(rng)
        estimated = rigid(rng.normal(size=3), np.degrees(angle)) * true
        ours.append(np.radians(pose_error(estimated, true, BOX).rotation_deg))
        by_trace.append(np.radians(angle_by_trace(estimated, true)))
    assert np.abs(np.array(ours) - angle).max() < 1e-9
    assert np.abs(np.array(by_trace) - angle).max() > 1e-9


def test_a_rotation_with_trace_above_three_has_angle_zero():
    """Rounding can produce such a matrix, whose arc cosine is NaN without clipping."""
    rounded = np.eye(3) * (1 + 1e-12)
    assert np.trace(rounded) > 3
    with np.errstate(invalid="ignore"):
        assert np.isnan(np.arccos((np.trace(rounded) - 1) / 2))
    estimated = pycolmap.Rigid3d(pycolmap.Rotation3d(rounded), np.zeros(3))
    assert pose_error(estimated, rigid(), BOX).rotation_deg == 0.0


def test_a_pose_and_its_opposite_quaternion_are_the_same():
    pose = rigid((1, 2, 3), 20.0)
    opposite = pycolmap.Rigid3d(pycolmap.Rotation3d(-pose.rotation.quat), pose.translation)
    assert pose_error(opposite, pose, BOX).rotation_deg == 0.0


def test_half_a_turn_is_an_error_only_for_an_asymmetric_object():
    half_a_turn = rigid(angle_deg=180.0)
    assert model_error(half_a_turn, rigid(), model_of(PILLAR, symmetric=True)) == pytest.approx(0, abs=1e-15)
    assert model_error(half_a_turn, rigid(), model_of(PILLAR)) == pytest.approx(
        4 * 2 * np.sqrt(5) / 6 / 10  # four of six vertices swap with their opposites
    )


def test_a_quarter_turn_is_an_error_for_an_object_with_half_turn_symmetry():
    assert model_error(rigid(angle_deg=90.0), rigid(), model_of(PILLAR, symmetric=True)) > 0.01


def test_adds_searches_the_nearest_estimated_vertex_of_each_true_vertex():
    """True at 0, 1, 10, estimated at 9, 10, 19: distances 9, 8, 0; in the other direction 1, 0, 9."""
    line = model_of([[0, 0, 0], [1, 0, 0], [10, 0, 0]], symmetric=True)
    assert model_error(rigid(translation=(9, 0, 0)), rigid(), line) == pytest.approx(17 / 3 / 10)


def test_the_diagonal_is_the_largest_distance_of_two_corners_of_any_box():
    """Rotated, sheared or flat: without right angles the diagonals differ, and the longest one counts."""
    rng = np.random.default_rng(2)
    edges = [rng.normal(size=(3, 3)) for _ in range(50)]
    edges += [np.diag([1.0, 0.0, 0.0]), np.diag([3.0, 2.0, 1.0]) @ random_pose(rng).rotation.matrix()]
    edges += [np.array([[1.0, 0, 0], [0.9, 0.3, 0], [0, 0, 1.0]])]
    for half_edges in edges:
        box = Box(rng.normal(size=3), half_edges)
        longest = max(np.linalg.norm(a - b) for a, b in combinations(box.corners, 2))
        assert box.diagonal == pytest.approx(longest)
        shift = rigid(translation=(0, 0, longest / 10))
        assert pose_error(shift, rigid(), box).relative == pytest.approx(0.1)


def test_errors_are_relative_to_the_diameter_of_the_model():
    shift = rigid(translation=(0, 0, 1.0))
    for diameter in (5.0, 20.0):
        model = model_of(PILLAR, diameter=diameter)
        assert model_error(shift, rigid(), model) == pytest.approx(1 / diameter)


@pytest.mark.parametrize("model", [None, model_of(PILLAR), model_of(PILLAR, symmetric=True)])
def test_no_pose_is_infinitely_wrong_and_counts_as_failure(model):
    assert pose_error(None, rigid(), BOX, model) is NO_POSE
    errors = [pose_error(pose, rigid(), BOX, model) for pose in (None, rigid(), rigid(), None)]
    relative, degrees, meters = (
        np.array([getattr(one, name) for one in errors])
        for name in ("relative", "rotation_deg", "translation")
    )
    for fraction in (0.1, 1.0, 1e9):
        assert add_percent(relative, fraction) == 50.0
    assert deg_cm_percent(degrees, meters, 5) == 50.0
    assert within_deg_cm(degrees, meters, 180).tolist() == [False, True, True, False]


def test_add_counts_errors_strictly_below_the_fraction():
    errors = np.array([0.0, 0.0199, 0.02, 0.05, 0.0999, 0.1, 3.0, np.inf])
    assert [add_percent(errors, fraction) for fraction in (0.02, 0.05, 0.1)] == [25.0, 37.5, 62.5]


@pytest.mark.parametrize(
    ("deg", "meters", "expected"),
    [
        (1.0, 0.01, 100.0),
        (1.0001, 0.01, 0.0),
        (1.0, 0.0101, 0.0),
        (0.0, 0.0, 100.0),
        (0.2, 0.03, 0.0),
        (3.0, 0.002, 0.0),
    ],
)
def test_degrees_and_centimeters_must_both_be_within(deg, meters, expected):
    assert deg_cm_percent(np.array([deg]), np.array([meters]), 1) == expected


@pytest.mark.parametrize("n", [1, 3, 5])
def test_translations_are_in_meters_and_the_boundary_of_n_degrees_n_centimeters_is_within(n):
    degrees = np.array([float(n)])
    assert deg_cm_percent(degrees, np.array([n / 100]), n) == 100.0
    assert deg_cm_percent(degrees, np.array([n / 100 + 1e-6]), n) == 0.0
    assert deg_cm_percent(degrees + 1e-9, np.array([n / 100]), n) == 0.0


def test_only_sure_poses_count_as_wrong_when_sure():
    """A confidence above 0.9 is sure; an error of a tenth of the diagonal is wrong; NaN is not sure."""
    errors = np.array([0.01, 0.1, 0.5, 0.5, np.inf])
    confidence = np.array([0.95, 0.99, 0.9, 0.2, np.nan])
    assert wrong_when_sure(errors, confidence, 0.1) == 0.5
    assert wrong_when_sure(errors[2:], confidence[2:], 0.1) is None


def test_errors_are_immutable():
    with pytest.raises(AttributeError):
        NO_POSE.rotation_deg = 0.0  # pyright: ignore[reportAttributeAccessIssue]
    assert replace(NO_POSE, rotation_deg=0.0).rotation_deg == 0.0
