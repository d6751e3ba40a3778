from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from handmade import outcomes_like, rigid

from scenes import BOX
from slimsfm.datasets.base import ObjectModel
from slimsfm.evaluation.results import join_outcomes, outcomes_of
from slimsfm.localization import Localization, Seconds
from slimsfm.pose import PoseEstimate


def localization(pose=None, *, confidence=None, references=3, seconds=(0.01, 0.02, 0.005)):
    extract, match, of_pose = seconds
    inliers = np.ones(20, dtype=bool)
    return Localization(
        pose=pose and PoseEstimate(cam_from_world=pose, inliers=inliers, confidence=confidence),
        camera=pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480),
        points2D=np.zeros((20, 2)),
        points3D_in_world=np.zeros((20, 3)),
        references=references,
        seconds=Seconds(extract=extract, match=match, pose=of_pose),
    )


def test_entry_i_of_each_field_belongs_to_query_i():
    shift = rigid(translation=(0, 0, 0.1))
    found = [
        localization(shift, confidence=0.75, references=7, seconds=(1.0, 2.0, 3.0)),
        localization(references=0, seconds=(4.0, 5.0, 6.0)),
        localization(rigid(), references=2, seconds=(7.0, 8.0, 9.0)),
    ]
    outcomes = outcomes_of(found, [rigid()] * 3, BOX)
    assert len(outcomes) == 3
    assert outcomes.error == pytest.approx([0.1 / BOX.diagonal, np.inf, 0.0])
    assert outcomes.rotation_deg.tolist() == [0.0, np.inf, 0.0]
    assert outcomes.translation == pytest.approx([0.1, np.inf, 0.0])
    assert outcomes.confidence[0] == 0.75
    assert np.isnan(outcomes.confidence[1:]).all()  # no pose, or no confidence
    assert outcomes.references.tolist() == [7, 0, 2]
    assert outcomes.seconds.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert [pose is None for pose in outcomes.cam_from_world] == [False, True, False]


def test_errors_use_the_vertices_of_a_model():
    half_a_turn = rigid(angle_deg=180.0)
    pair = ObjectModel(vertices=np.array([[1.0, 0, 0], [-1.0, 0, 0]]), diameter=2.0, symmetric=True)
    outcomes = outcomes_of([localization(half_a_turn)], [rigid()], BOX, pair)
    assert outcomes.error == pytest.approx([0], abs=1e-12)
    assert outcomes.rotation_deg == pytest.approx([180])


def test_there_must_be_queries_each_with_a_true_pose():
    with pytest.raises(ValueError, match="at least one query"):
        outcomes_of([], [], BOX)
    with pytest.raises(ValueError, match="zip"):
        outcomes_of([localization()], [], BOX)
    with pytest.raises(ValueError, match="zip"):
        outcomes_of([localization(rigid()), localization(rigid())], [rigid()], BOX)


def test_all_fields_have_the_same_length():
    two = outcomes_like([0.1, 0.2])
    with pytest.raises(ValueError, match="the same number of queries"):
        replace(two, cam_from_world=two.cam_from_world[:1])


def test_joined_outcomes_are_concatenated():
    first, second = outcomes_like([0.1, np.inf]), outcomes_like([0.3], references=8)
    both = join_outcomes([first, second])
    assert both.error.tolist() == [0.1, np.inf, 0.3]
    assert both.references.tolist() == [3, 3, 8]
    assert both.seconds.shape == (3, 3)
    assert both.cam_from_world == first.cam_from_world + second.cam_from_world
