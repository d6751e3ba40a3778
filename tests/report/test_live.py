import re
import socket
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from browsing import browsing, opened, viser, wait_until
from slimsfm.errors import InputError
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import copy_images, copy_points, direct_map
from slimsfm.report.live import WeighedMap, live_view, plain
from slimsfm.report.live_stage import DROPPED_RGB, KEPT_RGB
from slimsfm.report.scene3d import view_frame


def is_seen(view, name):
    """Whether a node and all above it are shown."""
    parts = name.split("/")
    above = ["/".join(parts[:end]) for end in range(2, len(parts) + 1)]
    handles = [view.server.scene.get_handle_by_name(one) for one in above]
    return handles[-1] is not None and all(handle is None or handle.visible for handle in handles)


def seen_images(view):
    return {name: one.color for name, one in view.frustums.items() if is_seen(view, one.name)}


def seen_points(view):
    (name,) = [f"/{word}/points" for word in view.maps if is_seen(view, f"/{word}/points")]
    return view.server.scene.get_handle_by_name(name)


def said(view):
    """All text of the panel."""
    handles = view.server.gui._container_handle_from_uuid["root"]._children.values()
    return "\n".join(one.content for one in handles if isinstance(one, viser.GuiMarkdownHandle))


def for_direct_matching(full, rows):
    descriptors = np.eye(len(rows), 8, dtype=np.float32)
    return direct_map(full, PointDescriptors(points=np.array(rows), descriptors=descriptors))


def moved(map):
    """The same map in another frame."""
    model = copy_images(map, list(map.images), keypoints=False)
    copy_points(map, model, {i: [] for i in map.point3D_ids.tolist()})
    turn = pycolmap.Rotation3d(np.array([0, 0, 1.0]))
    model.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
    return replace(map, model=model)


def test_one_map_is_shown_with_its_points_and_images(full):
    with opened(full) as view:
        assert seen_images(view) == dict.fromkeys(full.images, KEPT_RGB)
        frame = view_frame([image.cam_from_world() for image in full.images.values()], full.box)
        points = seen_points(view)
        np.testing.assert_allclose(points.points, frame.apply(full.points3D_in_world), atol=1e-6)
        np.testing.assert_array_equal(points.colors, full.colors)
        assert "4 images, 30 points, 24 MB" in said(view)
        assert view.switch == {}


def test_the_box_has_its_twelve_edges(full):
    with opened(full) as view:
        edges = view.server.scene.get_handle_by_name("/box").points
        lengths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1) * full.box.diagonal
        np.testing.assert_allclose(np.sort(lengths), np.repeat([0.6, 0.8, 1.0], 4), atol=1e-6)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_frustums_stand_where_the_cameras_stood_and_span_what_they_saw(full, camera):
    poses = [image.cam_from_world() for image in full.images.values()]
    frame = view_frame(poses, full.box)
    on_plane = camera.cam_from_img(np.array([[0, 0], [320, 0], [320, 240], [0, 240.0]]))
    corners_in_cam = np.column_stack([on_plane, np.ones(4)])
    with opened(full) as view:
        for pose, one in zip(poses, view.frustums.values(), strict=True):
            (center,) = frame.apply(pose.inverse().translation[None])
            np.testing.assert_allclose(one.position, center, atol=1e-6)
            y = np.tan(one.fov / 2)
            corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * [y * one.aspect, y, 1]
            in_view = corners @ viser.transforms.SO3(one.wxyz).as_matrix().T
            expected = frame.apply(pose.inverse() * corners_in_cam) - center
            np.testing.assert_allclose(unit(in_view), unit(expected), atol=1e-6)


def test_before_tells_kept_from_dropped_images_and_after_shows_only_what_is_kept(full, reduced):
    with opened(full, reduced) as view, browsing(view) as browser:
        dropped = dict.fromkeys(("1.jpg", "3.jpg", "4.jpg"), DROPPED_RGB)
        assert seen_images(view) == {**dropped, "2.jpg": KEPT_RGB}
        assert len(seen_points(view).points) == 30
        assert re.search(r"4 images, 30 points, 24 MB\n1 image, 20 points, 24 MB", said(view))
        browser.press(view.switch["After"])
        wait_until(lambda: seen_images(view) == {"2.jpg": KEPT_RGB})
        assert len(seen_points(view).points) == 20
        browser.press(view.switch["Before"])
        wait_until(lambda: len(seen_images(view)) == 4)


def test_of_a_map_for_direct_matching_only_the_points_are_left(full):
    with opened(full, for_direct_matching(full, [1, 5, 8])) as view:
        assert seen_images(view) == dict.fromkeys(full.images, DROPPED_RGB)
        view.show("After")
        assert seen_images(view) == {}
        assert len(seen_points(view).points) == 3
        assert "\n3 points, 24 MB" in said(view)


def test_a_map_for_direct_matching_by_itself_has_cameras_that_see_nothing(full):
    with opened(for_direct_matching(full, [1, 5, 8])) as view, browsing(view) as browser:
        assert seen_images(view) == dict.fromkeys(full.images, KEPT_RGB)
        browser.click(view.frustums["2.jpg"])
        wait_until(lambda: view.told.content == f"**{plain('2.jpg')}**")


def test_photos_fill_frustums_small_and_missing_ones_are_counted(full, tmp_path):
    for name in ("1.jpg", "3.jpg"):
        Image.new("RGB", (1280, 960), (255, 0, 0)).save(tmp_path / name)
    (tmp_path / "4.jpg").write_text("no image")
    with opened(full) as view:
        assert view.show_photos(tmp_path) == 2
        shapes = {name: None if one.image is None else one.image.shape for name, one in view.frustums.items()}
        assert shapes == {"1.jpg": (240, 320, 3), "2.jpg": None, "3.jpg": (240, 320, 3), "4.jpg": None}


def test_a_click_on_an_image_looks_from_there_and_tells_what_it_sees(full, reduced):
    with opened(full, reduced) as view, browsing(view) as browser:
        clicked = view.frustums["2.jpg"]
        browser.click(clicked)
        wait_until(lambda: plain("2.jpg") in view.told.content)
        assert "sees 20 points" in view.told.content
        axis = viser.transforms.SO3(clicked.wxyz).as_matrix()[:, 2]
        ahead = browser.camera.position - clicked.position
        assert 0 < ahead @ axis == pytest.approx(np.linalg.norm(ahead))
        assert abs(browser.camera.wxyz @ clicked.wxyz) == pytest.approx(1)
        np.testing.assert_allclose(
            browser.camera.look_at, 0, atol=1e-6
        )  # the cameras look at the box's middle


def test_a_view_ends_with_its_context(full):
    with opened(full) as view:
        port = view.server.get_port()
        socket.create_connection(("localhost", port)).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", port))


def test_a_port_that_cannot_be_had_is_refused(full):
    weighed = WeighedMap(map=full, num_bytes=1)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of localhost"), live_view(weighed, port=port):
            pass
    with pytest.raises(InputError, match="got 70000"), live_view(weighed, port=70_000):
        pass
    with pytest.raises(InputError, match=r"nowhere\.invalid"), live_view(weighed, host="nowhere.invalid"):
        pass


def test_maps_without_a_common_frame_are_refused(full, reduced):
    with pytest.raises(InputError, match=r"'1\.jpg' is not in the map"), opened(reduced, full):
        pass
    with pytest.raises(InputError, match=r"'2\.jpg' stands elsewhere"), opened(full, moved(reduced)):
        pass


def test_text_is_shown_as_it_is():
    assert plain("a_b*<i>.jpg") == r"a\_b\*\<i\>\.jpg"
