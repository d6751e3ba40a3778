import base64
import io
import re

import numpy as np
import pycolmap
import pytest
from PIL import Image as PillowImage

from slimsfm.geometry import BOX_EDGES, Box, project
from slimsfm.report.frames import ESTIMATED_RGB, MAX_SIDE_PX, TRUE_RGB, QueryFrame, draw_frame, frame_html

BOX = Box(np.zeros(3), np.diag([0.5, 0.4, 0.3]))
AHEAD = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.3, -0.4, 0.1])), np.array([0.0, 0.0, 3.0]))
ASIDE = pycolmap.Rigid3d(AHEAD.rotation, np.array([0.15, 0.1, 3.0]))


def query(camera, *, estimated=None, true=None, error=None, label="query.jpg"):
    return QueryFrame(
        image=np.full((camera.height, camera.width, 3), 128, np.uint8),
        camera=camera,
        estimated_cam_from_world=estimated,
        true_cam_from_world=true,
        label=label,
        relative_corner_error=error,
    )


def has_color(image, color, xy):
    """Whether the pixel that holds a point is of a colour."""
    column, row = np.floor(xy).astype(int)
    return np.abs(image[row, column].astype(int) - color).max() < 60


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "OPENCV"])
@pytest.mark.parametrize(("which", "color"), [("estimated", ESTIMATED_RGB), ("true", TRUE_RGB)])
def test_edges_run_where_projection_says(model, which, color):
    camera = pycolmap.Camera.create_from_model_name(1, model, 300.0, 320, 240)
    if model == "OPENCV":
        camera.params = np.array([300, 300, 160, 120, -0.3, 0.1, 0.01, -0.02])
    image = draw_frame(query(camera, **{which: AHEAD}), BOX)
    for i, j in BOX_EDGES:
        shares = np.linspace(0, 1, 40)[:, None]
        on_edge = BOX.corners[i] + shares * (BOX.corners[j] - BOX.corners[i])
        assert all(has_color(image, color, xy) for xy in project(on_edge, AHEAD, camera))


def test_only_the_edges_are_drawn(camera):
    image = draw_frame(query(camera, estimated=AHEAD), BOX)
    shares = np.linspace(0, 1, 60)[:, None]
    edges = np.concatenate(
        [BOX.corners[i] + shares * (BOX.corners[j] - BOX.corners[i]) for i, j in BOX_EDGES]
    )
    rows, columns = np.nonzero(np.any(image != 128, axis=2))
    drawn = np.stack([columns, rows], axis=1) + 0.5
    gaps = np.linalg.norm(drawn[:, None] - project(edges, AHEAD, camera)[None], axis=2).min(axis=1)
    assert len(drawn)
    assert gaps.max() < 4


def test_both_boxes_are_seen_also_where_they_coincide(camera):
    for estimated in (AHEAD, ASIDE):
        image = draw_frame(query(camera, estimated=estimated, true=AHEAD), BOX).astype(int)
        for color in (ESTIMATED_RGB, TRUE_RGB):
            assert np.sum(np.abs(image - color).max(axis=2) < 60) > 100


def test_a_query_without_poses_stays_as_it_is(camera):
    frame = query(camera)
    np.testing.assert_array_equal(draw_frame(frame, BOX), frame.image)


def test_a_box_behind_the_camera_is_not_drawn(camera):
    behind = pycolmap.Rigid3d(AHEAD.rotation, np.array([0.0, 0.0, -3.0]))
    assert np.all(draw_frame(query(camera, estimated=behind), BOX) == 128)


def test_of_a_box_around_the_camera_the_part_ahead_is_drawn(camera):
    inside = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, -0.1]))
    box = Box(np.zeros(3), np.diag([0.05, 0.05, 2.0]))
    image = draw_frame(query(camera, estimated=inside), box)
    for near, far in [(i, j) for i, j in BOX_EDGES if box.corners[i][2] != box.corners[j][2]]:
        ahead = 0.4 * box.corners[near] + 0.6 * box.corners[far]
        assert has_color(image, ESTIMATED_RGB, project(ahead[None], inside, camera)[0])


def test_what_distortion_folds_back_into_the_image_is_not_drawn():
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300.0, 320, 240)
    camera.params = np.array([300.0, 160.0, 120.0, -0.1])
    far_aside = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([3.15, 0.0, 1.0]))
    small = Box(np.zeros(3), 0.01 * np.eye(3))
    folded = project(small.corners, far_aside, camera)
    assert np.all((folded > 0) & (folded < [320, 240]))
    assert np.all(draw_frame(query(camera, estimated=far_aside), small) == 128)


def test_a_large_image_is_scaled_down_with_its_box():
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 1800.0, 1920, 1440)
    image = draw_frame(query(camera, estimated=AHEAD), BOX)
    assert image.shape == (MAX_SIDE_PX * 3 // 4, MAX_SIDE_PX, 3)
    corners = project(BOX.corners, AHEAD, camera) * MAX_SIDE_PX / 1920
    assert all(has_color(image, ESTIMATED_RGB, xy) for xy in corners)


def test_the_page_holds_the_drawn_image(camera):
    frame = query(camera, estimated=ASIDE, true=AHEAD, error=0.0213)
    html = frame_html(frame, BOX)
    data = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', html)
    with PillowImage.open(io.BytesIO(base64.b64decode(data[0]))) as file:
        shown = np.array(file)
    assert np.abs(shown.astype(float) - draw_frame(frame, BOX)).mean() < 3
    assert "corners off by 2.1 % of the diagonal" in html


def test_captions_say_what_became_of_a_query(camera):
    assert "not localized" in frame_html(query(camera, true=AHEAD), BOX)
    assert "true pose unknown" in frame_html(query(camera, estimated=AHEAD), BOX)
    assert "<b>&lt;b&gt;.jpg</b>" in frame_html(query(camera, label="<b>.jpg"), BOX)


def test_a_camera_of_another_size_is_refused(camera):
    with pytest.raises(ValueError, match="camera is of 320x240 pixels, the image of 10x20"):
        QueryFrame(
            image=np.zeros((20, 10, 3), np.uint8),
            camera=camera,
            estimated_cam_from_world=None,
            true_cam_from_world=None,
            label="",
            relative_corner_error=None,
        )
