"""When whole frames are searched, counted with a localizer that finds what it is told to."""

import numpy as np
import pytest

from scenes import camera, poses
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.pose import PoseEstimate
from slimsfm.tracking import Tracker, TrackerOptions
from slimsfm.tracking.relocalization import Recovery

BLACK = np.zeros((480, 640, 3), np.uint8)
CAMERA = camera()
LAST = poses(6)[0]


def found(confidence):
    pose = PoseEstimate(cam_from_world=LAST, inliers=np.zeros(0, bool), confidence=confidence)
    return Localization(
        pose=None if confidence is None else pose,
        camera=CAMERA,
        points2D=np.zeros((0, 2)),
        points3D_in_world=np.zeros((0, 3)),
        references=0,
        seconds=Seconds(extract=0.0, match=0.0, pose=0.0),
    )


class Finds(Localizer):
    """Gives every frame a pose of this confidence, or none, and remembers where it was asked to look."""

    def __init__(self, confidence=None):
        self.confidence, self.frame, self.whole, self.near = confidence, 0, [], []

    def localize(self, *_):
        self.whole.append(self.frame)
        return found(self.confidence)

    def localize_near(self, *arguments):
        self.near.append(arguments[2])
        return found(self.confidence)


def sought(localizer, recovery, frames):
    results = []
    for localizer.frame in frames:
        results.append(recovery.seek(localizer.frame, BLACK, CAMERA))
    return results


@pytest.mark.parametrize(
    ("longest", "whole"),
    [(8, [0, 1, 3, 7, 15, 23, 31, 39]), (3, [0, 1, 3, 6, 9, 12, 15, 18]), (1, list(range(8)))],
)
def test_whole_frames_are_searched_at_once_and_then_ever_more_rarely(longest, whole):
    localizer = Finds()
    recovery = Recovery(localizer, longest, 0.8)
    recovery.lost(0, LAST)
    sought(localizer, recovery, range(whole[-1] + 1))
    assert localizer.whole == whole
    assert len(localizer.near) == whole[-1] + 1 - len(whole)
    assert all(near is LAST for near in localizer.near)


def test_what_was_never_seen_is_not_sought_nearby():
    localizer = Finds()
    results = sought(localizer, Recovery(localizer, 8, 0.8), range(20))
    assert localizer.whole == [0, 1, 3, 7, 15]
    assert not localizer.near
    assert not any(one.pose for one in results)


def test_what_is_lost_again_is_searched_for_at_once():
    localizer = Finds()
    recovery = Recovery(localizer, 8, 0.8)
    sought(localizer, recovery, range(20))
    recovery.lost(20, LAST)
    sought(localizer, recovery, range(20, 24))
    assert localizer.whole[-3:] == [20, 21, 23]


@pytest.mark.parametrize(("confidence", "believed"), [(0.79, False), (0.8, True), (None, False)])
def test_a_pose_that_is_not_sure_is_not_believed(confidence, believed):
    localizer = Finds(confidence)
    recovery = Recovery(localizer, 8, 0.8)
    recovery.lost(0, LAST)
    assert [one.pose is not None for one in sought(localizer, recovery, range(4))] == 4 * [believed]
    assert len(localizer.near) == 1


def test_a_track_that_nothing_beside_bears_out_is_given_up(localizer, walk, monkeypatch):
    monkeypatch.setattr(localizer, "localize_near", lambda *_: found(None))
    tracker = Tracker(localizer, TrackerOptions(renew_every=4, lag=2))
    results = [tracker.track(image) for image in 14 * walk.images[:1]]
    states = [one.state for one in results]
    assert states == ["localized", *9 * ["tracked"], "localized", *3 * ["tracked"]]
    sure, doubted = (results[frame].pose.confidence for frame in (1, 8))
    assert doubted == pytest.approx(sure / 2)
