from dataclasses import replace

import pytest

from slimsfm.datasets.base import ObjectSequences, PosedSequence, map_object
from slimsfm.errors import InputError
from slimsfm.evaluation.right_poses import with_marks, with_right_poses
from wrong_poses import matched_map, swapped, turned


def sequences_of(truth, queries, folder):
    def sequence(names):
        return PosedSequence(
            folder=folder,
            names=tuple(names),
            cameras=tuple(truth.camera(name) for name in names),
            cam_from_world=tuple(truth.images[name].cam_from_world() for name in names),
        )

    mapping = [name for name in truth.images if name not in queries]
    return ObjectSequences(
        name="box", mapping=sequence(mapping), query=sequence(queries), box=truth.box, truth=truth
    )


@pytest.fixture(scope="module")
def right():
    return matched_map()


QUERIES = "001.png", "004.png", "007.png", "010.png"


def test_right_poses_change_nothing(right, tmp_path):
    given = sequences_of(right, QUERIES, tmp_path)
    found = with_right_poses(given)
    assert found.sequences is given
    assert found.contradicted == {}


def test_contradicted_queries_and_mapping_images_are_left_out_with_the_evidence(right, tmp_path):
    found = with_right_poses(sequences_of(swapped(right, "004.png", "009.png"), QUERIES, tmp_path))
    assert list(found.contradicted) == ["004.png", "009.png"]
    assert "disjoint sets of references" in found.contradicted["004.png"]
    assert found.sequences.query.names == ("001.png", "007.png", "010.png")
    assert "009.png" not in found.sequences.mapping.names
    assert len(found.sequences.mapping.cameras) == len(found.sequences.mapping.cam_from_world) == 7
    made = map_object(found.sequences, tmp_path)
    assert not {"004.png", "009.png", *QUERIES} & made.images.keys()


def test_marked_images_are_left_out(right, tmp_path):
    marked = replace(right, info=replace(right.info, wrong_poses=("007.png",)))
    assert list(with_right_poses(sequences_of(marked, QUERIES, tmp_path)).contradicted) == ["007.png"]


def test_poses_from_another_source_and_models_without_matches_are_not_checked(right, tmp_path):
    wrong = sequences_of(replace(swapped(right, "004.png", "009.png"), matches={}), QUERIES, tmp_path)
    for given in (wrong, replace(wrong, truth=None)):
        assert with_right_poses(given).sequences is given


def test_without_a_right_query_the_object_is_an_error(right, tmp_path):
    with pytest.raises(InputError, match="leaves too few to measure with"):
        with_right_poses(sequences_of(turned(right, "004.png", 40), ["004.png"], tmp_path))


def test_wrong_poses_of_a_full_map_are_marked(right):
    assert with_marks(right) is right
    assert with_marks(turned(right, "004.png", 40)).info.wrong_poses == ("004.png",)
