"""Templates of a textured plane, whose images from any pose a homography gives exactly."""

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pictures import cloth, grid
from slimsfm.geometry import project
from slimsfm.tracking.templates import (
    GrayFrame,
    cut_templates,
    find_templates,
    join_templates,
    spread_over_cells,
)

CAMERA = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[300.0, 300.0, 160.0, 120.0])
DISTANCE = 3.0
HERE = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, DISTANCE]))
"""A pose that shows the plane z = 0 from the front."""


def rigid(turn_deg, translation):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.radians(turn_deg)), np.array(translation, float))


def seen_from(cam_from_world, cloth_seen_from_here):
    """Image from a pose of the plane that looks like this from HERE."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    here, there = (project(corners, pose, CAMERA).astype(np.float32) - 0.5 for pose in (HERE, cam_from_world))
    homography = cv2.getPerspectiveTransform(here, there)
    gray = cv2.warpPerspective(cloth_seen_from_here, homography, (320, 240), flags=cv2.INTER_CUBIC)
    return GrayFrame(gray=gray, camera=CAMERA, scale=1.0)


@pytest.fixture(scope="module")
def templates():
    points2D = grid(margin=50, step=16)
    rays = np.asarray(CAMERA.cam_from_img(points2D))
    points3D = np.column_stack([rays * DISTANCE, np.zeros(len(rays))])
    return cut_templates(GrayFrame(gray=cloth(), camera=CAMERA, scale=1.0), points2D, points3D, HERE)


@pytest.mark.parametrize(
    "pose",
    [
        HERE,
        rigid([0, 0, 35], [0.1, 0, 3.0]),
        rigid([0, 0, 0], [0, 0.1, 2.3]),
        rigid([0, 0, -10], [0, 0, 3.9]),
        rigid([12, -14, 5], [0, 0, 3.1]),
    ],
    ids=["unchanged", "rolled", "nearer", "farther", "slanted"],
)
def test_templates_are_found_from_another_pose(templates, pose):
    off = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.02, -0.015, 0.0])) * pose  # 2 or 3 pixels
    sighting = find_templates(templates, seen_from(pose, cloth()), off)
    assert sighting.num_expected > len(templates) / 2
    assert len(sighting.rows) >= 0.9 * sighting.num_expected
    true = project(templates.points3D_in_world[sighting.rows], pose, CAMERA)
    assert np.median(np.linalg.norm(sighting.points2D - true, axis=1)) < 0.15


def test_brightness_and_contrast_do_not_matter(templates):
    view = seen_from(HERE, cloth())
    dim = GrayFrame(gray=(40 + 0.5 * view.gray).astype(np.uint8), camera=CAMERA, scale=1.0)
    bright, faint = find_templates(templates, view, HERE), find_templates(templates, dim, HERE)
    assert np.array_equal(bright.rows, faint.rows)
    assert np.allclose(bright.points2D, faint.points2D, atol=0.05)


def test_covered_templates_are_not_found(templates):
    half_covered = cloth()
    half_covered[:, 160:] = cloth(seed=1)[:, 160:]
    sighting = find_templates(templates, GrayFrame(gray=half_covered, camera=CAMERA, scale=1.0), HERE)
    assert sighting.num_expected == len(templates)
    x = templates.points3D_in_world[sighting.rows, 0] * 100 + 160
    assert np.mean(x > 168) < 0.05
    assert len(x) > 0.4 * len(templates)


@pytest.mark.parametrize("gray", [0, 128, 255])
def test_nothing_is_found_in_a_uniform_image(templates, gray):
    view = GrayFrame(gray=np.full((240, 320), gray, np.uint8), camera=CAMERA, scale=1.0)
    assert len(find_templates(templates, view, HERE).rows) == 0


def test_no_template_is_expected_from_behind_or_far_aside(templates):
    for pose in (rigid([0, 0, 0], [0, 0, -3]), rigid([0, 60, 0], [0, 0, 3]), rigid([0, 0, 0], [50, 0, 3])):
        sighting = find_templates(templates, GrayFrame(gray=cloth(), camera=CAMERA, scale=1.0), pose)
        assert (len(sighting.rows), sighting.num_expected) == (0, 0)


def test_joining_keeps_one_template_per_point_and_prefers_the_new(templates):
    some, others = templates[np.arange(10)], templates[np.arange(5, 20)]
    both = join_templates(some, others, limit=100)
    assert len(both) == 20
    assert np.array_equal(both.points3D_in_world[:10], some.points3D_in_world)
    assert len(join_templates(some, others, limit=12)) == 12
    assert len(join_templates(some, others, limit=5)) == 10


@settings(deadline=None, max_examples=50)
@given(
    places=st.lists(st.tuples(st.integers(0, 99), st.integers(0, 99)), max_size=40),
    limit=st.integers(1, 50),
)
def test_every_cell_gets_a_match_before_one_gets_two(places, limit):
    points2D = np.array(places, float).reshape(-1, 2)
    points3D = np.column_stack([np.arange(len(places)) // 2] * 3).astype(float)  # each point is matched twice
    rows = spread_over_cells(points2D, points3D, limit, cell_px=25.0)
    assert np.all(np.diff(rows) > 0)
    assert len(np.unique(points3D[rows], axis=0)) == len(rows) == min(limit, (len(places) + 1) // 2)
    cells = [tuple(cell) for cell in points2D // 25]
    chosen = [cells[row] for row in rows]
    candidates = [cells[row] for row in range(0, len(cells), 2)]
    most = max(map(chosen.count, chosen), default=0)
    for cell in set(candidates):
        assert chosen.count(cell) >= min(candidates.count(cell), most - 1)
