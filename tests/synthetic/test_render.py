import cv2
import numpy as np
import pycolmap
import pytest
import trimesh

from slimsfm.geometry import project
from slimsfm.synthetic import shapes
from slimsfm.synthetic.render import Light, Scene, render, visible_meshes
from slimsfm.synthetic.scene import look_at

AMBIENT = Light(lamp=(0.0, 0.0, 0.0), ambient=(1.0, 1.0, 1.0), backdrop=(10.0, 20.0, 30.0))
PINHOLE = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[300, 305, 163.2, 117.9])
RADIAL = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[300, 158.3, 121.4, -0.08])


def plain(color, size=64):
    return np.full((size, size, 3), color, np.uint8)


def chequerboard(squares=8, texels=60):
    cells = np.indices((squares, squares)).sum(axis=0) % 2
    image = np.repeat(np.kron(cells, np.ones((texels, texels)))[..., None] * 200 + 20, 3, axis=2)
    return image.astype(np.uint8)


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL], ids=["pinhole", "radial"])
@pytest.mark.parametrize(
    "eye", [(0.1, -0.2, 0.45), (0.3, 0.1, 0.35), (-0.25, -0.15, 0.3)], ids=["near", "right", "slanted"]
)
def test_known_points_appear_at_their_projections(camera, eye):
    scene = Scene([shapes.ground(0.32, chequerboard(), z=0.0)], AMBIENT)
    cam_from_world = look_at(np.array(eye), np.array([0.01, 0.02, 0.0]), roll_deg=20.0)
    steps = np.arange(-3, 4) * 0.04
    corners = np.array([(x, y, 0.0) for x in steps for y in steps])
    expected = project(corners, cam_from_world, camera)
    gray = cv2.cvtColor(render(scene, camera, cam_from_world), cv2.COLOR_RGB2GRAY)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    start = (expected - 0.5).astype(np.float32)[:, None]
    found = cv2.cornerSubPix(gray, start + 0.7, (4, 4), (-1, -1), criteria)[:, 0] + 0.5
    offsets = found - expected
    assert np.mean(np.linalg.norm(offsets, axis=1)) < 0.1
    assert np.all(np.abs(offsets.mean(axis=0)) < 0.03)


@pytest.mark.parametrize("side", range(4))
def test_a_print_is_upright_and_not_mirrored_on_each_side_of_a_box(side):
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = 50, 100, 150, 200
    scene = Scene([shapes.box((0.2, 0.2, 0.2), [image] * 6)], AMBIENT)
    angle = np.pi / 2 * (side - 1)
    seen = render(scene, PINHOLE, look_at(np.array([np.cos(angle), np.sin(angle), 0.0]), np.zeros(3)))
    center_x, center_y = 163, 118
    corners = [seen[center_y + dy, center_x + dx, 0] for dy in (-12, 12) for dx in (-12, 12)]
    assert corners == [50, 100, 150, 200]


def test_a_plain_surface_has_the_color_of_texture_times_light():
    light = Light(towards=(0.0, 0.0, 5.0), lamp=(0.5, 0.25, 0.0), ambient=(0.25, 0.25, 0.5))
    scene = Scene([shapes.ground(3.0, plain((100, 120, 140)), z=0.0)], light)
    seen = render(scene, PINHOLE, look_at(np.array([0.1, 0.0, 0.5]), np.zeros(3)))
    assert np.unique(seen.reshape(-1, 3), axis=0).tolist() == [[75, 60, 70]]


def test_the_nearer_of_two_meshes_hides_the_other_and_nothing_shows_the_backdrop():
    floor, small = shapes.ground(0.2, plain(50), z=0.0), shapes.ground(0.05, plain(200), z=0.1)
    scene = Scene([floor, small], AMBIENT)
    pose = look_at(np.array([0.0, -0.01, 0.6]), np.zeros(3))
    meshes, seen = visible_meshes(scene, PINHOLE, pose), render(scene, PINHOLE, pose)
    for place, mesh, color in (
        ((118, 163), 1, [200] * 3),
        ((118, 200), 0, [50] * 3),
        ((2, 2), -1, [10, 20, 30]),
    ):
        assert meshes[place] == mesh
        assert seen[place].tolist() == color


def test_a_texture_far_away_is_blurred_to_its_mean_instead_of_aliased():
    fine = np.indices((512, 512)).sum(axis=0) % 2 * np.uint8(200)
    scene = Scene(
        [shapes.ground(0.5, np.repeat(fine[..., None].astype(np.uint8), 3, axis=2), z=0.0)], AMBIENT
    )
    seen = render(scene, PINHOLE, look_at(np.array([0.0, -0.3, 3.0]), np.zeros(3)))
    inner = seen[105:130, 150:175, 0].astype(float)
    assert abs(inner.mean() - 100) < 2
    assert inner.std() < 3


def test_equal_scenes_give_equal_images():
    pose = look_at(np.array([0.3, 0.2, 0.4]), np.zeros(3))
    images = [
        render(Scene([shapes.ground(0.3, chequerboard(), z=0.0)], AMBIENT), PINHOLE, pose) for _ in range(2)
    ]
    assert np.array_equal(*images)


def test_a_mesh_without_texture_is_an_error():
    with pytest.raises(ValueError, match="meshes must have a texture"):
        Scene([trimesh.creation.box()], AMBIENT)
