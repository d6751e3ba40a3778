import base64
import io
import re

import numpy as np
import pycolmap
import pytest
from PIL import Image as PillowImage

from slimsfm.geometry import BOX_EDGES, Box, project
from slimsfm.report.frames import ESTIMATED_RGB, TRUE_RGB, QueryFrame, draw_frame, frame_html

BOX = Box(np.zeros(3), np.diag([0.5, 0.4, 0.3]))
AHEAD = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.3, -0.4, 0.1])), np.array([0.0, 0.0, 3.0]))
AWAY = pycolmap.Rigid3d(AHEAD.rotation, np.array([0.0, 0.0, -3.0]))  # sees nothing of the box
MAX_SIZE = 480
ASIDE = pycolmap.Rigid3d(AHEAD.rotation, np.array([0.15, 0.1, 3.0]))


def query(camera, *, estimated=None, true=AWAY, label="query.jpg", verdict=""):
    return QueryFrame(
        image=np.full((camera.height, camera.width, 3), 128, np.uint8),
        camera=camera,
        estimated_cam_from_world=estimated,
        true_cam_from_world=true,
        label=label,
        verdict=verdict,
    )


def has_color(image, color, xy):
    """Whether the pixel that holds a point has a color."""
    column, row = np.floor(xy).astype(int)
    return np.abs(image[row, column].astype(int) - color).max() < 60


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "OPENCV"])
@pytest.mark.parametrize(("which", "color"), [("estimated", ESTIMATED_RGB), ("true", TRUE_RGB)])
def test_edges_run_where_projection_says(model, which, color):
    camera = pycolmap.Camera.create_from_model_name(1, model, 300.0, 320, 240)
    if model == "OPENCV":
        camera.params = np.array([300, 300, 160, 120, -0.3, 0.1, 0.01, -0.02])
    image = draw_frame(query(camera, **{which: AHEAD}), BOX, MAX_SIZE)
    for i, j in BOX_EDGES:
        shares = np.linspace(0, 1, 40)[:, None]
        on_edge = BOX.corners[i] + shares * (BOX.corners[j] - BOX.corners[i])
        assert all(has_color(image, color, xy) for xy in project(on_edge, AHEAD, camera))


def test_only_the_edges_are_drawn(camera):
    image = draw_frame(query(camera, estimated=AHEAD), BOX, MAX_SIZE)
    shares = np.linspace(0, 1, 60)[:, None]
    edges = np.concatenate(
        [BOX.corners[i] + shares * (BOX.corners[j] - BOX.corners[i]) for i, j in BOX_EDGES]
    )
    rows, columns = np.nonzero(np.any(image != 128, axis=2))
    drawn = np.stack([columns, rows], axis=1) + 0.5
    gaps = np.linalg.norm(drawn[:, None] - project(edges, AHEAD, camera)[None], axis=2).min(axis=1)
    assert len(drawn)
    assert gaps.max() < 4


def test_both_boxes_are_visible_even_if_they_coincide(camera):
    for estimated in (AHEAD, ASIDE):
        image = draw_frame(query(camera, estimated=estimated, true=AHEAD), BOX, MAX_SIZE).astype(int)
        for color in (ESTIMATED_RGB, TRUE_RGB):
            assert np.sum(np.abs(image - color).max(axis=2) < 60) > 100


def test_boxes_behind_the_camera_are_not_drawn(camera):
    frame = query(camera, estimated=AWAY, true=AWAY)
    np.testing.assert_array_equal(draw_frame(frame, BOX, MAX_SIZE), frame.image)


def test_of_a_box_around_the_camera_the_part_in_front_is_drawn(camera):
    inside = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, -0.1]))
    box = Box(np.zeros(3), np.diag([0.05, 0.05, 2.0]))
    image = draw_frame(query(camera, estimated=inside), box, MAX_SIZE)
    for near, far in [(i, j) for i, j in BOX_EDGES if box.corners[i][2] != box.corners[j][2]]:
        ahead = 0.4 * box.corners[near] + 0.6 * box.corners[far]
        assert has_color(image, ESTIMATED_RGB, project(ahead[None], inside, camera)[0])


def test_points_that_distortion_folds_back_into_the_image_are_not_drawn():
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300.0, 320, 240)
    camera.params = np.array([300.0, 160.0, 120.0, -0.1])
    far_aside = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([3.15, 0.0, 1.0]))
    small = Box(np.zeros(3), 0.01 * np.eye(3))
    folded = project(small.corners, far_aside, camera)
    assert np.all((folded > 0) & (folded < [320, 240]))
    assert np.all(draw_frame(query(camera, estimated=far_aside), small, MAX_SIZE) == 128)


def test_a_large_image_is_scaled_down_with_its_box():
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 1800.0, 1920, 1440)
    image = draw_frame(query(camera, estimated=AHEAD), BOX, MAX_SIZE)
    assert image.shape == (MAX_SIZE * 3 // 4, MAX_SIZE, 3)
    corners = project(BOX.corners, AHEAD, camera) * MAX_SIZE / 1920
    assert all(has_color(image, ESTIMATED_RGB, xy) for xy in corners)


def test_the_page_embeds_the_drawn_image_and_its_caption(camera):
    frame = query(camera, estimated=ASIDE, true=AHEAD, label="<b>.jpg", verdict="off by <2 %")
    html = frame_html(frame, BOX, MAX_SIZE)
    data = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', html)
    with PillowImage.open(io.BytesIO(base64.b64decode(data[0]))) as file:
        shown = np.array(file)
    assert np.abs(shown.astype(float) - draw_frame(frame, BOX, MAX_SIZE)).mean() < 3
    assert "<b>&lt;b&gt;.jpg</b> off by &lt;2 %" in html


def test_a_camera_of_another_size_is_refused(camera):
    with pytest.raises(ValueError, match="camera has 320x240 pixels, the image 10x20"):
        QueryFrame(
            image=np.zeros((20, 10, 3), np.uint8),
            camera=camera,
            estimated_cam_from_world=None,
            true_cam_from_world=AHEAD,
            label="",
            verdict="",
        )
