import base64
import json

import numpy as np
import pycolmap
import pytest
from matplotlib.colors import to_hex

from slimsfm.geometry import BOX_EDGES
from slimsfm.report.figures import CHOSEN
from slimsfm.report.scene3d import before_after_figure, scene_json, view_frame


def points_of(shown):
    return np.frombuffer(base64.b64decode(shown["points"]), "<f4").reshape(-1, 3)


def colors_of(shown):
    return np.frombuffer(base64.b64decode(shown["colors"]), np.uint8).reshape(-1, 3)


def poses_of(map):
    return [image.cam_from_world() for image in map.images.values()]


def test_the_view_keeps_shapes_and_centers_the_box(full):
    shown = scene_json({"full": full}, ())
    corners = np.array(shown["box"])
    np.testing.assert_allclose(corners.mean(axis=0), 0, atol=1e-4)
    between = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    expected = np.linalg.norm(full.box.corners[:, None] - full.box.corners[None], axis=2) / full.box.diagonal
    np.testing.assert_allclose(between, expected, atol=5e-4)
    points = points_of(shown["maps"]["full"])
    to_corners = np.linalg.norm(points[:, None] - corners[None], axis=2) * full.box.diagonal
    in_world = np.linalg.norm(full.points3D_in_world[:, None] - full.box.corners[None], axis=2)
    np.testing.assert_allclose(to_corners, in_world, atol=1e-3)


def test_the_view_is_right_handed_with_the_images_upright_and_the_cameras_ahead(full):
    frame = view_frame(poses_of(full), full.box)
    rotation = frame.view_from_world * full.box.diagonal
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    ups = [rotation @ -pose.rotation.matrix()[1] for pose in poses_of(full)]
    np.testing.assert_allclose(ups, np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    middle = frame.apply(np.array([pose.inverse().translation for pose in poses_of(full)])).mean(axis=0)
    assert middle[0] > 1
    assert middle[1] == pytest.approx(0, abs=1e-9)


def test_opposite_cameras_still_give_a_view(full):
    about_x = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([np.pi, 0, 0])), np.zeros(3))
    frame = view_frame([pycolmap.Rigid3d(), about_x], full.box)
    rotation = frame.view_from_world * full.box.diagonal
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_frusta_start_at_the_camera_and_face_what_it_sees(full):
    shown = scene_json({"full": full}, ())
    frame = view_frame(poses_of(full), full.box)
    for frustum, pose in zip(shown["images"], poses_of(full), strict=True):
        center, *corners = np.array(frustum)
        np.testing.assert_allclose(center, frame.apply(pose.inverse().translation[None])[0], atol=1e-4)
        axis = np.mean(corners, axis=0) - center  # these cameras look at the box's center, here the origin
        assert axis @ -center == pytest.approx(np.linalg.norm(axis) * np.linalg.norm(center), rel=1e-3)


def test_each_map_shows_its_own_images_and_points(full, reduced):
    shown = scene_json({"full": full, "dominating": reduced}, ["2.jpg"])
    assert shown["chosen"] == [0, 1, 0, 0]
    before, after = shown["maps"]["full"], shown["maps"]["dominating"]
    assert before["images"] == [0, 1, 2, 3]
    assert after["images"] == [1]
    np.testing.assert_array_equal(points_of(after), points_of(before)[:20])
    np.testing.assert_array_equal(colors_of(before), full.colors)


def test_many_points_are_subsampled_evenly(full):
    everything = points_of(scene_json({"full": full}, ())["maps"]["full"])
    shown = scene_json({"full": full}, (), max_points=10)["maps"]["full"]
    rows = [int(np.flatnonzero((everything == point).all(axis=1))[0]) for point in points_of(shown)]
    assert len(colors_of(shown)) == len(rows) == 10
    assert rows[0] == 0
    assert rows[-1] == 29
    assert set(np.diff(rows)) <= {3, 4}


def test_the_scene_is_plain_json(full, reduced):
    shown = scene_json({"full": full, "slim": reduced}, ())
    assert json.loads(json.dumps(shown, allow_nan=False))["maps"] == shown["maps"]


def collection(axes, label):
    return next(one for one in axes.collections if one.get_label() == label)


def test_the_figure_shows_every_point_camera_and_edge_of_the_box(full, reduced):
    axes, _ = before_after_figure(full, reduced).axes
    points = collection(axes, "points")
    assert len(points.get_offsets()) == 30
    shown = {tuple(row) for row in np.round(255 * points.get_facecolors()[:, :3]).astype(int).tolist()}
    assert shown == {tuple(row) for row in full.colors.tolist()}
    assert len(collection(axes, "box").get_segments()) == len(BOX_EDGES)
    assert len(collection(axes, "chosen").get_segments()) == 8
    assert len(collection(axes, "dropped").get_segments()) == 3 * 8
    assert to_hex(collection(axes, "chosen").get_color()[0]) == CHOSEN
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    for label in ("box", "chosen", "dropped"):
        corners = np.concatenate(collection(axes, label).get_segments())
        assert (low <= corners).all()
        assert (corners <= high).all()


def test_before_and_after_are_seen_from_one_place(full, reduced):
    before, after = before_after_figure(full, reduced).axes
    assert (before.get_xlim(), before.get_ylim()) == (after.get_xlim(), after.get_ylim())
    np.testing.assert_allclose(
        collection(before, "chosen").get_segments(), collection(after, "chosen").get_segments()
    )
    assert len(collection(before, "dropped").get_segments()) == 3 * 8
    assert not collection(after, "dropped").get_segments()
    kept = {tuple(row) for row in collection(after, "points").get_offsets().tolist()}
    assert len(kept) == 20
    assert kept < {tuple(row) for row in collection(before, "points").get_offsets().tolist()}
    said = [axes.get_title(loc="left") for axes in (before, after)]
    assert said == ["Before: 4 images, 30 points", "After: 1 image, 20 points"]
