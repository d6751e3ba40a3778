from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import BOX
from slimsfm.evaluation.metrics import (
    NO_POSE,
    PoseError,
    add_percent,
    confidence_wrong,
    deg_cm_percent,
    pose_error,
    score,
)
from slimsfm.localization import Localization, Seconds
from slimsfm.pose import PoseEstimate

DIAGONAL = 2 * np.sqrt(1.0**2 + 0.8**2 + 0.6**2)


def rigid(axis=(0.0, 0.0, 1.0), angle_deg=0.0, translation=(0.0, 0.0, 0.0)):
    half = np.radians(angle_deg) / 2
    quaternion = [*(np.sin(half) * np.array(axis) / np.linalg.norm(axis)), np.cos(half)]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(quaternion)), np.array(translation, np.float64))


def error(corner=0.0, deg=0.0, translation=0.0):
    return PoseError(relative_corner_error=corner, rotation_deg=deg, translation=translation)


def localization(pose=None, extract=0.01, match=0.02, pose_seconds=0.005, confidence=None):
    inliers = np.ones(20, dtype=bool)
    return Localization(
        pose=pose and PoseEstimate(cam_from_world=pose, inliers=inliers, confidence=confidence),
        camera=pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480),
        points2D=np.zeros((20, 2)),
        points3D_in_world=np.zeros((20, 3)),
        references=3,
        seconds=Seconds(extract=extract, match=match, pose=pose_seconds),
    )


def test_equal_poses_have_no_error():
    pose = rigid((1, 2, 3), 77.0, (1, -2, 3))
    assert pose_error(pose, pose, BOX) == error()


def test_a_shift_moves_every_corner_by_its_length():
    found = pose_error(rigid(translation=(0.03, 0.04, 0.0)), rigid(), BOX)
    assert found.relative_corner_error == pytest.approx(0.05 / DIAGONAL)
    assert found.translation == pytest.approx(0.05)
    assert found.rotation_deg == 0.0


@pytest.mark.parametrize("angle_deg", [1e-6, 0.5, 10.0, 90.0, 179.999, 180.0])
def test_a_turn_about_z_moves_every_corner_along_its_chord(angle_deg):
    """All corners are equally far from the axis; a chord is twice that radius times the half angle's sine."""
    found = pose_error(rigid(angle_deg=angle_deg), rigid(), BOX)
    chord = 2 * np.hypot(1.0, 0.8) * np.sin(np.radians(angle_deg) / 2)
    assert found.relative_corner_error == pytest.approx(chord / DIAGONAL, rel=1e-6)
    assert found.rotation_deg == pytest.approx(angle_deg, rel=1e-6)
    assert found.translation == 0.0


def random_pose(rng):
    quaternion = rng.normal(size=4)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), rng.normal(size=3))


def test_errors_agree_with_the_published_formulas_on_a_thousand_poses():
    """The arc cosine of the trace, the distance of the translations, the mean over the corners."""
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(1000):
        a, b = random_pose(rng), random_pose(rng)
        found = pose_error(a, b, BOX)
        R, t = a.rotation.matrix(), a.translation
        S, s = b.rotation.matrix(), b.translation
        angle = np.degrees(np.arccos(np.clip((np.trace(R.T @ S) - 1) / 2, -1, 1)))
        if 1 < angle < 179:
            compared += 1
            assert found.rotation_deg == pytest.approx(angle, abs=1e-9)
        assert found.translation == pytest.approx(np.sqrt(np.sum((t - s) ** 2)))
        distances = [np.linalg.norm((R @ corner + t) - (S @ corner + s)) for corner in BOX.corners]
        assert found.relative_corner_error == pytest.approx(np.mean(distances) / DIAGONAL)
        assert pose_error(b, a, BOX).relative_corner_error == pytest.approx(found.relative_corner_error)
    assert compared > 950


def test_no_pose_is_infinitely_wrong_and_counts_as_failure():
    assert pose_error(None, rigid(), BOX) is NO_POSE
    errors = [NO_POSE, error(), error(), NO_POSE]
    assert add_percent(errors, 0.1) == 50.0
    assert deg_cm_percent(errors, 5) == 50.0


def test_add_counts_what_is_below_the_fraction():
    errors = [error(corner) for corner in (0.0, 0.0199, 0.02, 0.05, 0.0999, 0.1, 3.0, np.inf)]
    assert [add_percent(errors, fraction) for fraction in (0.02, 0.05, 0.1)] == [25.0, 37.5, 62.5]


@pytest.mark.parametrize(
    ("deg", "translation", "expected"),
    [
        (1.0, 0.01, 100.0),
        (1.0001, 0.01, 0.0),
        (1.0, 0.0101, 0.0),
        (0.0, 0.0, 100.0),
        (0.2, 0.03, 0.0),
        (3.0, 0.002, 0.0),
    ],
)
def test_degrees_and_centimetres_must_both_be_within(deg, translation, expected):
    assert deg_cm_percent([error(deg=deg, translation=translation)], 1) == expected


@pytest.mark.parametrize("n", [1, 3, 5])
def test_the_boundary_of_n_degrees_n_centimetres_is_within(n):
    assert deg_cm_percent([error(deg=float(n), translation=n / 100)], n) == 100.0
    assert deg_cm_percent([error(deg=float(n), translation=n / 100 + 1e-6)], n) == 0.0


def test_scores_sum_up_mixed_outcomes():
    errors = [error(0.01, 0.5, 0.004), error(0.03, 2.0, 0.02), error(0.2, 20.0, 0.1), NO_POSE, NO_POSE]
    found = [localization(rigid())] * 3 + [localization(), localization(extract=0.06, match=0.12)]
    scores = score(errors, found, metric=True)
    assert scores.queries == 5
    assert scores.localized == 60.0
    assert scores.add == {0.1: 40.0, 0.05: 40.0, 0.02: 20.0}
    assert scores.deg_cm == {1: 20.0, 3: 40.0, 5: 40.0}
    assert scores.median_corner_error == 0.2
    assert scores.seconds.extract == pytest.approx(0.02)
    assert scores.seconds.match == pytest.approx(0.04)
    assert scores.seconds.pose == pytest.approx(0.005)
    assert scores.fps == pytest.approx(1 / 0.065)


def test_without_a_metric_unit_there_are_no_centimetres():
    assert score([error()], [localization(rigid())], metric=False).deg_cm is None


def test_the_median_is_infinite_unless_more_than_half_are_localized():
    found = [localization()] * 4
    assert np.isinf(
        score([error(0.01), error(0.01), NO_POSE, NO_POSE], found, metric=False).median_corner_error
    )
    most = score([error(0.01), error(0.02), error(0.04), NO_POSE], found, metric=False)
    assert most.median_corner_error == pytest.approx(0.03)


def test_no_query_has_no_score():
    with pytest.raises(ValueError, match="at least one query"):
        score([], [], metric=True)


def test_results_cannot_be_changed():
    with pytest.raises(AttributeError):
        NO_POSE.rotation_deg = 0.0
    assert replace(NO_POSE, rotation_deg=0.0).rotation_deg == 0.0


def test_only_sure_poses_count_as_wrong_when_sure():
    pose = rigid((0, 0, 1), 10.0, (0, 0, 2))
    found = [localization(pose, confidence=one) for one in (0.95, 0.99, 0.9, 0.2)] + [localization()]
    errors = [error(0.01), error(0.1), error(0.5), error(0.5), NO_POSE]
    assert confidence_wrong(errors, found) == 0.5
    assert confidence_wrong(errors[2:], found[2:]) is None
    assert score(errors, found, metric=False).confidence_wrong == 0.5
    assert score(errors, found, metric=False).references_tried == 3
