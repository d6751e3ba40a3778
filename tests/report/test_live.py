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
from slimsfm.mapping.support import measure
from slimsfm.report.live import MapWithSize, live_view
from slimsfm.report.live_panel import DROPPED_RGB, KEPT_RGB, plain_markdown
from slimsfm.report.scene3d import view_frame


def is_visible(browser, name):
    """Whether a node and its ancestors are visible."""
    parts = name.split("/")
    ancestors = ["/".join(parts[:end]) for end in range(2, len(parts) + 1)]
    handles = [browser.scene.get_handle_by_name(one) for one in ancestors]
    return handles[-1] is not None and all(handle is None or handle.visible for handle in handles)


def visible_images(browser):
    return {name: one.color for name, one in browser.viewer.frusta.items() if is_visible(browser, one.name)}


def visible_points(browser):
    (points,) = [one for one in browser.viewer.points.values() if is_visible(browser, one.name)]
    return points


def descriptions(browser):
    return [one.content for one in browser.viewer.descriptions.values()]


@pytest.fixture
def watching(full):
    """A view of a map, and a browser."""
    with opened(full) as view, browsing(view) as browser:
        yield view, browser


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


def test_one_map_is_shown_with_its_points_and_images(full, watching):
    _, browser = watching
    assert visible_images(browser) == dict.fromkeys(full.images, KEPT_RGB)
    frame = view_frame([image.cam_from_world() for image in full.images.values()], full.box)
    points = visible_points(browser)
    np.testing.assert_allclose(points.points, frame.apply(full.points3D_in_world), atol=1e-6)
    np.testing.assert_array_equal(points.colors, full.colors)
    assert descriptions(browser) == ["4 images, 30 points, 24 MB"]
    assert browser.viewer.switch == {}
    assert browser.viewer.warnings == []


def test_a_doubted_map_is_shown_with_a_warning(full):
    quality = replace(measure(full.model, {}, full.images), contradictions={"a_1.jpg": 0.2})
    doubted = replace(full, info=replace(full.info, quality=quality))
    with opened(doubted) as view, browsing(view) as browser:
        (warning,) = browser.viewer.warnings
        assert plain_markdown("contradict the poses of 1 of 4 images") in warning.content
        assert plain_markdown("a_1.jpg (20%)") in warning.content


def test_the_box_has_its_twelve_edges(full, watching):
    _, browser = watching
    edges = browser.viewer.box.points
    lengths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1) * full.box.diagonal
    np.testing.assert_allclose(np.sort(lengths), np.repeat([0.6, 0.8, 1.0], 4), atol=1e-6)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_frusta_are_at_the_cameras_and_span_their_images(full, camera, watching):
    _, browser = watching
    poses = [image.cam_from_world() for image in full.images.values()]
    frame = view_frame(poses, full.box)
    on_plane = camera.cam_from_img(np.array([[0, 0], [320, 0], [320, 240], [0, 240.0]]))
    corners_in_cam = np.column_stack([on_plane, np.ones(4)])
    for pose, one in zip(poses, browser.viewer.frusta.values(), strict=True):
        (center,) = frame.apply(pose.inverse().translation[None])
        np.testing.assert_allclose(one.position, center, atol=1e-6)
        y = np.tan(one.fov / 2)
        corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * [y * one.aspect, y, 1]
        in_view = corners @ viser.transforms.SO3(one.wxyz).as_matrix().T
        expected = frame.apply(pose.inverse() * corners_in_cam) - center
        np.testing.assert_allclose(unit(in_view), unit(expected), atol=1e-6)


def test_before_marks_kept_and_dropped_images_and_after_shows_the_kept_ones(full, reduced):
    with opened(full, reduced) as view, browsing(view) as browser:
        dropped = dict.fromkeys(("1.jpg", "3.jpg", "4.jpg"), DROPPED_RGB)
        assert visible_images(browser) == {**dropped, "2.jpg": KEPT_RGB}
        assert len(visible_points(browser).points) == 30
        assert descriptions(browser) == ["4 images, 30 points, 24 MB", "1 image, 20 points, 24 MB"]
        browser.press(browser.viewer.switch["After"])
        wait_until(lambda: visible_images(browser) == {"2.jpg": KEPT_RGB})
        assert len(visible_points(browser).points) == 20
        browser.press(browser.viewer.switch["Before"])
        wait_until(lambda: len(visible_images(browser)) == 4)


def test_each_viewer_has_its_own_switch_and_camera(full, reduced):
    with opened(full, reduced) as view, browsing(view) as one, browsing(view) as other:
        position = other.camera.position.copy()
        one.press(one.viewer.switch["After"])
        wait_until(lambda: len(visible_images(one)) == 1)
        one.click(one.viewer.frusta["2.jpg"])
        wait_until(lambda: "2" in one.viewer.message.content)
        assert len(visible_images(other)) == 4
        assert other.viewer.shown == "Before"
        assert "Click" in other.viewer.message.content
        np.testing.assert_array_equal(other.camera.position, position)


def test_the_size_of_the_points_can_be_changed(watching):
    _, browser = watching
    before = visible_points(browser).point_size
    browser.set(browser.viewer.point_size, 0.5)
    wait_until(lambda: visible_points(browser).point_size == pytest.approx(before / 2))


def test_a_map_for_direct_matching_shows_only_points(full):
    with opened(full, for_direct_matching(full, [1, 5, 8])) as view, browsing(view) as browser:
        assert visible_images(browser) == dict.fromkeys(full.images, DROPPED_RGB)
        browser.press(browser.viewer.switch["After"])
        wait_until(lambda: visible_images(browser) == {})
        assert len(visible_points(browser).points) == 3
        assert descriptions(browser)[1] == "3 points, 24 MB"


def test_cameras_of_a_single_map_for_direct_matching_see_no_points(full):
    with opened(for_direct_matching(full, [1, 5, 8])) as view, browsing(view) as browser:
        assert visible_images(browser) == dict.fromkeys(full.images, KEPT_RGB)
        browser.click(browser.viewer.frusta["2.jpg"])
        wait_until(lambda: browser.viewer.message.content == f"**{plain_markdown('2.jpg')}**")


def test_photos_are_shown_in_frusta_and_missing_ones_are_counted(watching, tmp_path):
    view, browser = watching
    for name in ("1.jpg", "3.jpg"):
        Image.new("RGB", (1280, 960), (255, 0, 0)).save(tmp_path / name)
    (tmp_path / "4.jpg").write_text("no image")
    assert view.show_photos(tmp_path) == 2
    with browsing(view) as late:
        for one in (browser, late):
            images = {name: frustum.image for name, frustum in one.viewer.frusta.items()}
            shapes = {name: None if image is None else image.shape for name, image in images.items()}
            assert shapes == {"1.jpg": (240, 320, 3), "2.jpg": None, "3.jpg": (240, 320, 3), "4.jpg": None}


def test_a_click_on_an_image_flies_to_its_camera_and_counts_its_points(full, reduced):
    with opened(full, reduced) as view, browsing(view) as browser:
        clicked = browser.viewer.frusta["2.jpg"]
        browser.click(clicked)
        wait_until(lambda: plain_markdown("2.jpg") in browser.viewer.message.content)
        assert "sees 20 points" in browser.viewer.message.content
        wait_until(lambda: abs(browser.camera.wxyz @ clicked.wxyz) > 1 - 1e-9)
        wait_until(
            lambda: np.abs(browser.camera.look_at).max() < 1e-6
        )  # the cameras look at the box's center
        axis = viser.transforms.SO3(clicked.wxyz).as_matrix()[:, 2]
        ahead = browser.camera.position - clicked.position
        assert 0 < ahead @ axis == pytest.approx(np.linalg.norm(ahead))


def test_a_view_ends_with_its_context(full):
    with opened(full) as view:
        port = view.server.get_port()
        socket.create_connection(("localhost", port)).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", port))


def test_an_unavailable_port_is_refused(full):
    with_size = MapWithSize(map=full, num_bytes=1)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of localhost"), live_view(with_size, port=port):
            pass
    with pytest.raises(InputError, match="got 70000"), live_view(with_size, port=70_000):
        pass
    with pytest.raises(InputError, match=r"nowhere\.invalid"), live_view(with_size, host="nowhere.invalid"):
        pass


def test_maps_without_a_common_frame_are_refused(full, reduced):
    with pytest.raises(InputError, match=r"'1\.jpg' is not in the map"), opened(reduced, full):
        pass
    with pytest.raises(InputError, match=r"'2\.jpg' has another pose"), opened(full, moved(reduced)):
        pass


def test_text_is_escaped():
    assert plain_markdown("a_b*<i>.jpg") == r"a\_b\*\<i\>\.jpg"
