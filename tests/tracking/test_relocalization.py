"""The schedule of searches, counted with a localizer that returns a given result."""

import numpy as np
import pytest

from scenes import camera, poses
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.localization.cameras import QueryCamera
from slimsfm.pose import PoseEstimate
from slimsfm.tracking import Tracker, TrackerOptions
from slimsfm.tracking.background import Relocalizer

BLACK = np.zeros((480, 640, 3), np.uint8)
CAMERA = QueryCamera(camera=camera(), source="given")
LAST = poses(6)[0]


def found(confidence):
    pose = PoseEstimate(cam_from_world=LAST, inliers=np.zeros(0, bool), confidence=confidence)
    return Localization(
        pose=None if confidence is None else pose,
        camera=CAMERA.camera,
        points2D=np.zeros((0, 2)),
        points3D_in_world=np.zeros((0, 3)),
        references=0,
        seconds=Seconds(extract=0.0, match=0.0, pose=0.0),
    )


class FakeLocalizer(Localizer):
    """Returns a pose of this confidence, or none, for every frame, and records where it searched."""

    def __init__(self, confidence=None):
        self.confidence, self.frame, self.whole, self.near = confidence, 0, [], []

    def localize(self, *_):
        self.whole.append(self.frame)
        return found(self.confidence)

    def localize_near(self, *arguments):
        self.near.append(arguments[2])
        return found(self.confidence)


def localized(localizer, relocalizer, frames):
    results = []
    for localizer.frame in frames:
        results.append(relocalizer.localize(localizer.frame, BLACK, CAMERA))
    return results


@pytest.mark.parametrize(
    ("longest", "whole"),
    [(8, [0, 1, 3, 7, 15, 23, 31, 39]), (3, [0, 1, 3, 6, 9, 12, 15, 18]), (1, list(range(8)))],
)
def test_whole_frames_are_searched_at_once_and_then_after_ever_longer_pauses(longest, whole):
    localizer = FakeLocalizer()
    relocalizer = Relocalizer(localizer, longest, 0.8)
    relocalizer.mark_lost(0, LAST)
    localized(localizer, relocalizer, range(whole[-1] + 1))
    assert localizer.whole == whole
    assert len(localizer.near) == whole[-1] + 1 - len(whole)
    assert all(near is LAST for near in localizer.near)


def test_object_that_was_never_seen_is_not_searched_for_near_a_pose():
    localizer = FakeLocalizer()
    results = localized(localizer, Relocalizer(localizer, 8, 0.8), range(20))
    assert localizer.whole == [0, 1, 3, 7, 15]
    assert not localizer.near
    assert not any(one.pose for one in results)


def test_object_that_is_lost_again_is_searched_for_at_once():
    localizer = FakeLocalizer()
    relocalizer = Relocalizer(localizer, 8, 0.8)
    localized(localizer, relocalizer, range(20))
    relocalizer.mark_lost(20, LAST)
    localized(localizer, relocalizer, range(20, 24))
    assert localizer.whole[-3:] == [20, 21, 23]


@pytest.mark.parametrize(("confidence", "accepted"), [(0.79, False), (0.8, True), (None, False)])
def test_pose_of_low_confidence_is_rejected(confidence, accepted):
    localizer = FakeLocalizer(confidence)
    relocalizer = Relocalizer(localizer, 8, 0.8)
    relocalizer.mark_lost(0, LAST)
    assert [one.pose is not None for one in localized(localizer, relocalizer, range(4))] == 4 * [accepted]
    assert len(localizer.near) == 1


def test_track_that_background_localization_never_confirms_is_given_up(localizer, walk, monkeypatch):
    monkeypatch.setattr(localizer, "localize_near", lambda *_: found(None))
    tracker = Tracker(localizer, TrackerOptions(renew_every=4, lag=2))
    results = [tracker.track(image) for image in 14 * walk.images[:1]]
    states = [one.state for one in results]
    assert states == ["localized", *9 * ["tracked"], "localized", *3 * ["tracked"]]
    sure, doubted = (results[frame].pose.confidence for frame in (1, 8))
    assert doubted == pytest.approx(sure / 2)
