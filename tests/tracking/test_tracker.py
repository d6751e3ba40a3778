import time
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pycolmap
import pytest

from slimsfm.geometry import corner_error
from slimsfm.localization import Localizer
from slimsfm.pose.priors import with_focal_length
from slimsfm.tracking import Tracker, TrackerOptions

BLACK = np.zeros((240, 320, 3), np.uint8)
BUSY = TrackerOptions(renew_every=4, lag=3)


def tracked(localizer, images, options=BUSY):
    tracker = Tracker(localizer, options)
    return [tracker.track(image) for image in images]


def states(results):
    return [one.state for one in results]


def matrices(results):
    return [one.pose and one.pose.cam_from_world.matrix().tolist() for one in results]


def error(one, truth, box):
    return corner_error(one.pose.cam_from_world, truth, box)


@pytest.fixture(scope="module")
def walked(localizer, walk):
    """Results of tracking the sequence."""
    return tracked(localizer, walk.images)


def test_object_is_tracked_accurately_and_a_cut_is_noticed_at_once(localizer, walk, walked):
    half = len(walk.images) // 2
    assert states(walked) == 2 * ["localized", *["tracked"] * (half - 1)]
    errors = [error(one, t, localizer.map.box) for one, t in zip(walked, walk.cam_from_world, strict=True)]
    assert max(errors) < 0.03


def test_result_of_a_tracked_frame_is_complete(walked):
    for one in walked:
        assert one.seconds > 0
        assert 0 < one.pose.confidence <= 1
        assert one.num_points == one.pose.num_inliers >= 10
        localization = one.localization
        assert len(localization.points2D) == len(localization.points3D_in_world) == len(one.pose.inliers)
        assert localization.predicted_corner_error < 0.05


def test_results_say_which_pixels_they_are_of(localizer, walk):
    info = replace(localizer.map.info, orientation="stored")
    stored = Localizer(replace(localizer.map, info=info), localizer.options)
    for one in tracked(stored, [walk.images[0], walk.images[1], BLACK]):
        assert one.localization.orientation == "stored"


def test_a_wrong_focal_length_is_corrected_with_the_first_pose_and_kept(localizer, walk):
    right = localizer.map.shared_camera
    wrong = with_focal_length(right, 1.3 * right.mean_focal_length())
    tracker, images = Tracker(localizer, BUSY), walk.images[:8]
    first, *others = [tracker.track(image, wrong).localization for image in images]
    assert (first.camera_source, first.camera_estimated) == ("given", ("focal length",))
    assert first.camera.mean_focal_length() == pytest.approx(right.mean_focal_length(), rel=0.05)
    for one, truth in zip([first, *others], walk.cam_from_world, strict=False):
        assert corner_error(one.pose.cam_from_world, truth, localizer.map.box) < 0.05
        assert one.camera.params.tolist() == first.camera.params.tolist()
    assert {one.camera_source for one in others} == {"queries"}


def test_poses_do_not_depend_on_the_duration_of_background_work(localizer, walk, walked, monkeypatch):
    fast = localizer.localize_near
    delays_s = iter([0.3, 0.0, 0.2, 0.05] * 10)
    calls = []

    def slow(*arguments):
        calls.append(arguments)
        time.sleep(next(delays_s))
        return fast(*arguments)

    monkeypatch.setattr(localizer, "localize_near", slow)
    assert matrices(tracked(localizer, walk.images)) == matrices(walked)
    assert len(calls) >= 4


def test_poses_of_a_still_video_are_still(localizer, walk):
    first, *others = tracked(localizer, 10 * walk.images[:1])
    assert states(others) == 9 * ["tracked"]
    for one in others:
        assert error(one, first.pose.cam_from_world, localizer.map.box) < 0.003
    assert error(others[1], others[0].pose.cam_from_world, localizer.map.box) < 1e-3


def test_tracking_in_shrunk_frames_gives_poses_of_whole_frames(localizer, walk):
    large = [np.asarray(cv2.resize(image, (960, 720)), np.uint8) for image in walk.images[:4]]
    results = tracked(localizer, large, TrackerOptions(max_image_size=320))
    assert states(results) == ["localized", "tracked", "tracked", "tracked"]
    for one, truth in zip(results, walk.cam_from_world, strict=False):
        assert error(one, truth, localizer.map.box) < 0.03
        errors_px = one.localization.points2D.max(axis=0)
        assert np.all(errors_px > 320)  # in pixels of the frame


def test_black_frames_have_no_pose_and_the_object_is_found_again_at_once(localizer, walk):
    images = [*walk.images[:4], BLACK, BLACK, *walk.images[4:7]]
    results = tracked(localizer, images)
    assert states(results) == [
        *("localized", "tracked", "tracked", "tracked"),
        *("lost", "lost"),
        *("localized", "tracked", "tracked"),
    ]
    assert [one.pose is None for one in results] == [image is BLACK for image in images]
    assert results[4].num_points == 0


def test_object_passing_in_front_does_not_disturb_the_pose(localizer, walk):
    card = np.random.default_rng(0).integers(0, 256, (30, 20, 3), np.uint8)
    card = np.asarray(cv2.resize(card, (160, 240), interpolation=cv2.INTER_CUBIC), np.uint8)
    images = [walk.images[0].copy() for _ in range(24)]
    for step, image in enumerate(images):
        left = 320 - 16 * step
        shown = slice(max(left, 0), max(left + 160, 0))
        image[:, shown] = card[:, shown.start - left : 160][:, : max(320 - shown.start, 0)]
    results = tracked(localizer, images)
    errors = [error(one, walk.cam_from_world[0], localizer.map.box) for one in results if one.pose]
    assert len(errors) > 12
    assert max(errors) < 0.05
    assert results[-1].pose


def test_confidence_decreases_when_less_is_seen(localizer, walk):
    covered = walk.images[0].copy()
    covered[:, :165] = 90
    whole, part = tracked(localizer, [walk.images[0], covered], TrackerOptions())
    assert part.state == "tracked"
    assert part.pose.confidence < whole.pose.confidence


def test_smoothing_changes_the_returned_poses_and_not_the_tracking(localizer, walk):
    noise = np.random.default_rng(0).normal(0, 6, (8, *walk.images[0].shape))
    noisy = np.clip(walk.images[0] + noise, 0, 255).astype(np.uint8)
    raw, calm = (tracked(localizer, noisy, TrackerOptions(smoothing=strength)) for strength in (0.0, 5.0))
    jitter, calmed = (
        [error(b, a.pose.cam_from_world, localizer.map.box) for a, b in pairwise(results)]
        for results in (raw, calm)
    )
    assert np.mean(calmed) < np.mean(jitter)
    assert [one.num_points for one in raw] == [one.num_points for one in calm]


def test_frame_of_another_size_is_localized_from_scratch(localizer, walk):
    small = np.asarray(cv2.resize(walk.images[1], (300, 225), interpolation=cv2.INTER_AREA), np.uint8)
    results = tracked(localizer, [walk.images[0], small])
    assert states(results)[0] == "localized"
    assert states(results)[1] in ("localized", "lost")


def test_camera_of_another_size_is_rejected(localizer):
    other = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[600.0, 600.0, 320.0, 240.0])
    with pytest.raises(ValueError, match="size 320x240"):
        Tracker(localizer).track(BLACK, other)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_points", 0),
        ("max_image_size", 63),
        ("renew_every", 0),
        ("lag", 0),
        ("search_every", 0),
        ("begin_confidence", 1.1),
        ("smoothing", -1.0),
        ("smoothing", float("nan")),
    ],
)
def test_error_names_the_invalid_option(name, value):
    with pytest.raises(ValueError, match=f"{name} must"):
        TrackerOptions(**{name: value})


def test_several_trackers_can_share_a_localizer(boulder, walk):
    localizer = Localizer(boulder.map)
    one, other = Tracker(localizer, BUSY), Tracker(localizer, BUSY)
    apart = [matrices(tracked(localizer, images)) for images in (walk.images[:6], walk.images[12:18])]
    pairs = [(one.track(a), other.track(b)) for a, b in zip(walk.images[:6], walk.images[12:18], strict=True)]
    assert [matrices(results) for results in zip(*pairs, strict=True)] == apart
