from itertools import pairwise

import numpy as np
import pytest

from film import film
from slimsfm.geometry import project
from slimsfm.synthetic.render import visible_meshes

FRAMES = 400


@pytest.fixture(scope="module")
def shot():
    return film(frames=FRAMES, width=160, height=120)


@pytest.fixture(scope="module")
def short():
    return film("ball", 200, 64, 48, seed=3)


def corners_of(shot):
    return np.array([project(shot.box.corners, pose, shot.camera) for pose in shot.cam_from_object])


def steps_px(shot):
    """How far the box's corners move from each frame to the next, on the mean, in an image of 640 x 480."""
    scale = 640 / shot.camera.width
    return scale * np.linalg.norm(np.diff(corners_of(shot), axis=0), axis=2).mean(axis=1)


def turns_deg(shot):
    poses = shot.cam_from_object
    return np.array([np.degrees((b.rotation * a.rotation.inverse()).angle()) for a, b in pairwise(poses)])


def test_films_are_equal_for_equal_arguments_and_noise_differs_between_frames(short):
    one, two = short, film("ball", 200, 64, 48, seed=3)
    assert [a.matrix().tolist() for a in one.cam_from_object] == [
        b.matrix().tolist() for b in two.cam_from_object
    ]
    assert np.array_equal(one.visible, two.visible)
    for index in (5, one.occlusion.start - 1, one.occlusion.start + 3):
        assert np.array_equal(one.frame(index), two.frame(index))
    assert not np.array_equal(one.frame(0), one.frame(1))


def test_there_is_one_pose_and_one_share_per_frame(shot):
    assert len(shot.cam_from_object) == FRAMES
    assert shot.visible.shape == (FRAMES,)
    assert np.all((shot.visible >= 0) & (shot.visible <= 1))


def test_the_motion_is_continuous_except_at_the_cut(shot):
    steps, turns = steps_px(shot), turns_deg(shot)
    others = np.arange(FRAMES - 1) != shot.cut - 1
    assert steps[~others].item() > 80
    assert turns[~others].item() > 60
    assert steps[others].max() < 32
    assert turns[others].max() < 8
    assert np.abs(np.diff(turns))[others[1:] & others[:-1]].max() < 3


def test_some_passages_are_fast_and_others_calm(shot):
    steps = steps_px(shot)
    assert 0.12 < np.mean(steps > 15) < 0.4
    assert np.mean(steps < 3) > 0.4
    assert np.mean(turns_deg(shot) > 4) > 0.03


def test_the_object_lies_in_the_image_in_every_frame(shot):
    corners = corners_of(shot)
    assert corners.min() > 0
    assert np.all(corners < (shot.camera.width, shot.camera.height))


def test_nothing_hides_much_of_the_object_outside_the_occlusion(shot):
    held = np.arange(shot.occlusion.start - 12, shot.occlusion.stop + 12)
    assert np.delete(shot.visible, held).min() > 0.6
    assert shot.cut not in held


def test_the_occlusion_hides_every_pixel_of_the_object_and_parts_of_it_just_before_and_after(shot):
    start, stop = shot.occlusion.start, shot.occlusion.stop
    assert stop - start == FRAMES / 20
    for index in (start, start + 7, stop - 1):
        behind = visible_meshes(shot.scene, shot.camera, shot.cam_from_object[index]) == 0
        plate = visible_meshes(shot.plate, shot.camera, shot.cam_from_plate[index]) >= 0
        assert behind.sum() > 300
        assert np.mean(plate[behind]) > 0.995
    assert not np.any(shot.visible[start:stop])
    for near, far in ((shot.visible[start - 1], start - 10), (shot.visible[stop], stop + 10)):
        assert 0 < near < 0.9 * shot.visible[far]


def test_the_plate_is_drawn_where_it_is_and_out_of_sight_at_both_ends(shot):
    middle = (shot.occlusion.start + shot.occlusion.stop) // 2
    indices = list(shot.cam_from_plate)
    covered = [
        np.mean(visible_meshes(shot.plate, shot.camera, shot.cam_from_plate[index]) >= 0)
        for index in (indices[0], middle, indices[-1])
    ]
    assert covered[1] == 1
    assert max(covered[0], covered[2]) < 0.06
    calm, blocked = shot.frame(indices[0] - 1).astype(int), shot.frame(middle)
    assert np.abs(calm - blocked).mean() > 30


def test_in_a_short_film_of_another_object_the_same_happens(short):
    steps = steps_px(short)
    assert 10 <= len(short.occlusion) <= 16
    assert steps[short.cut - 1] > 80
    assert 15 < np.delete(steps, short.cut - 1).max() < 45


@pytest.mark.parametrize(
    ("name", "frames", "message"), [("teapot", 200, "name must be"), ("can", 199, "frames must be")]
)
def test_unknown_objects_and_short_films_are_errors(name, frames, message):
    with pytest.raises(ValueError, match=message):
        film(name, frames, 64, 48)
