from dataclasses import replace

import numpy as np
import pytest

from scenes import camera
from slimsfm.localization import Localization, Seconds
from slimsfm.localization.cameras import QueryCamera, guess_camera
from slimsfm.localization.shared_cameras import corrected_cameras, share_cameras
from slimsfm.pose import PoseEstimate, with_focal_length
from slimsfm.synthetic.scene import look_at

NAMES = [f"{index}.jpg" for index in range(20)]


def localized(focal_px, sigma, confidence=0.99):
    pose = PoseEstimate(
        cam_from_world=look_at(np.ones(3), np.zeros(3)),
        inliers=np.ones(30, bool),
        confidence=confidence,
        camera=with_focal_length(guess_camera(640, 480), focal_px),
        relative_focal_sigma=sigma,
    )
    return Localization(
        pose=pose,
        camera=camera(),
        points2D=np.zeros((30, 2)),
        points3D_in_world=np.zeros((30, 3)),
        references=1,
        seconds=Seconds(extract=0.0, match=0.0, pose=0.0),
    )


def unknown(size=(640, 480)):
    return QueryCamera(camera=guess_camera(*size), source="unknown", notes=("said",))


def shared(cameras, focal_lengths, sigma=0.03, confidence=0.99):
    asked = []

    def localize(names):
        asked.extend(names)
        values = np.resize(focal_lengths, len(names))
        return [localized(float(value), sigma, confidence) for value in values]

    return share_cameras(cameras, localize), asked


def test_photos_of_one_camera_get_the_focal_length_that_some_of_them_agree_on():
    found, asked = shared(dict.fromkeys(NAMES, unknown()), [498.0, 500.0, 502.0])
    assert list(found) == NAMES
    assert len(asked) == 8
    for one in found.values():
        assert (one.source, one.notes) == ("queries", ("said",))
        assert one.camera.mean_focal_length() == pytest.approx(500, rel=0.004)


@pytest.mark.parametrize(
    ("focal_lengths", "sigma", "confidence"),
    [([400.0, 500.0, 650.0], 0.03, 0.99), ([500.0], 0.3, 0.99), ([500.0], 0.03, 0.6)],
    ids=["disagree", "uncertain", "unsure"],
)
def test_otherwise_nothing_is_shared(focal_lengths, sigma, confidence):
    cameras = dict.fromkeys(NAMES, unknown())
    assert shared(cameras, focal_lengths, sigma, confidence)[0] == cameras


def test_a_camera_that_most_queries_contradict_is_replaced_for_the_others():
    believed = QueryCamera(camera=camera(), source="map")
    cameras = dict.fromkeys(NAMES[:6], believed)
    kept = replace(localized(500.0, 0.03), camera=camera())
    estimated = replace(kept, pose=replace(kept.pose, estimated=("focal length",)))
    found = dict(zip(cameras, [estimated, kept, estimated, estimated, estimated, kept], strict=True))
    again = corrected_cameras(cameras, found)
    assert list(again) == [NAMES[1], NAMES[5]]
    assert {one.source for one in again.values()} == {"queries"}
    assert again[NAMES[1]].camera.mean_focal_length() == pytest.approx(500.0)
    few = dict(zip(cameras, [estimated, kept, estimated, estimated, kept, kept], strict=True))
    assert corrected_cameras(cameras, few) == {}
    assert corrected_cameras(cameras, dict.fromkeys(cameras, kept)) == {}


def test_known_cameras_and_single_photos_are_left_alone():
    cameras = {
        "known.jpg": QueryCamera(camera=camera(), source="map"),
        **dict.fromkeys(["a.jpg", "b.jpg"], unknown()),
        **dict.fromkeys(["c.jpg", "d.jpg"], unknown((320, 240))),
        "e.jpg": replace(unknown(), source="exif"),
    }
    assert shared(cameras, [500.0]) == (cameras, [])
