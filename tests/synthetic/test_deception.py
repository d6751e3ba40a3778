from functools import cache

import numpy as np
import pycolmap
import pytest

from deception import (
    DECEPTIONS,
    FLOOR_PERIOD,
    TWIN_FROM_OBJECT,
    WALL_PERIOD,
    ambiguous_box,
    label_box,
    patterned_room_query,
    room,
    twins_query,
)
from slimsfm.synthetic.render import Light, Scene, render, visible_meshes
from slimsfm.synthetic.scene import look_at

AMBIENT = Light(lamp=(0.0, 0.0, 0.0), ambient=(1.0, 1.0, 1.0))
CENTERED = pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[200, 200, 80, 60])
X, Y, Z = np.eye(3)


@cache
def small(name, kind):
    return getattr(DECEPTIONS[name], kind)(3, 64, 48, 0)


def shifted(pose, by):
    return pose * pycolmap.Rigid3d(pycolmap.Rotation3d(), -by)


def print_on(mesh, side):
    """The picture on a side of a box, cut out of its texture."""
    image = np.asarray(mesh.visual.material.image)
    uv = mesh.visual.uv[4 * side : 4 * side + 4] * (1, -1) + (0, 1)
    (left, top), (right, bottom) = np.rint(uv[[0, 3]] * image.shape[1::-1]).astype(int)
    return image[top:bottom, left:right]


def difference(one, other):
    return float(np.abs(one.astype(int) - other).mean())


@pytest.mark.parametrize("name", DECEPTIONS)
@pytest.mark.parametrize("kind", ["mapping", "query"])
def test_frames_are_equal_for_equal_arguments_and_noise_differs_between_frames(name, kind):
    one, two = small(name, kind), getattr(DECEPTIONS[name], kind)(3, 64, 48, 0)
    assert len(one.cam_from_object) == 3
    assert np.array_equal(one.frame(1), two.frame(1))
    assert not np.array_equal(one.frame(1), one.frame(2))


@pytest.mark.parametrize("name", DECEPTIONS)
def test_the_object_is_the_first_mesh_of_both_takes_with_its_box_about_the_origin(name):
    mesh = DECEPTIONS[name].object(0)
    assert np.allclose(mesh.bounds.sum(axis=0), 0)
    for take in (small(name, "mapping"), small(name, "query")):
        assert np.array_equal(take.scene.vertices[: len(mesh.vertices)], mesh.vertices)


@pytest.mark.parametrize(
    ("sheet", "period", "axes", "eye"),
    [
        (0, FLOOR_PERIOD, (X, Y), (0.1, -0.3, 0.4)),
        (1, WALL_PERIOD, (X, Z), (0.3, -0.4, 0.1)),
        (2, WALL_PERIOD, (Y, Z), (0.4, -0.3, 0.1)),
    ],
    ids=["floor", "wall", "other wall"],
)
def test_from_a_period_away_floor_and_walls_look_the_same(sheet, period, axes, eye):
    scene = Scene([room(label_box(0), 0)[sheet]], Light())
    middle = scene.vertices.mean(axis=0)
    pose = look_at(middle + np.array(eye), middle, roll_deg=10.0)
    here = render(scene, CENTERED, pose)
    for by in (period * axes[0], -2 * period * axes[1], period * (axes[0] + axes[1])):
        there = render(scene, CENTERED, shifted(pose, by))
        assert np.mean(here != there) < 0.001
    assert difference(here, render(scene, CENTERED, shifted(pose, 0.5 * period * axes[0]))) > 10


def test_the_room_is_the_same_in_both_takes():
    parts = []
    for kind in ("mapping", "query"):
        scene = small("patterned_room", kind).scene
        uv = scene.attributes[np.isin(scene.mesh_of_face, [1, 2, 3])][..., :2]
        corners = scene.vertices[scene.faces[np.isin(scene.mesh_of_face, [1, 2, 3])]]
        parts.append((uv, corners))
    assert all(np.array_equal(one, other) for one, other in zip(*parts, strict=True))


def test_in_the_room_the_carton_is_sometimes_small_hidden_or_at_the_rim_but_never_absent():
    take = patterned_room_query(30, 80, 60, 0)
    alone = Scene([label_box(0)], Light())
    seen, whole = (
        np.array([visible_meshes(scene, take.camera, pose) == 0 for pose in take.cam_from_object])
        for scene in (take.scene, alone)
    )
    inner = whole[:, 1:-1, 1:-1].sum(axis=(1, 2))
    share, left = whole.mean(axis=(1, 2)), seen.sum(axis=(1, 2)) / whole.sum(axis=(1, 2))
    assert np.mean(share < 0.03) > 0.1
    assert np.mean(left < 0.75) > 0.1
    assert np.mean(inner < whole.sum(axis=(1, 2))) > 0.1
    assert seen.sum(axis=(1, 2)).min() > 20


def test_the_twin_is_the_object_moved_with_the_same_print():
    scene = small("twins", "query").scene
    object_, twin = (scene.mesh_of_face == mesh for mesh in (0, 2))
    corners, moved = (scene.vertices[scene.faces[faces]] for faces in (object_, twin))
    assert np.allclose(TWIN_FROM_OBJECT * corners.reshape(-1, 3), moved.reshape(-1, 3))
    assert np.array_equal(scene.attributes[object_][..., :2], scene.attributes[twin][..., :2])
    uv, ones = np.random.default_rng(0).random((2, 500)), np.ones(500)
    prints = [scene.texture.look_up(np.full(500, mesh), uv, ones) for mesh in (0, 2)]
    assert np.array_equal(*prints)


def test_the_twin_is_there_only_in_queries_and_mostly_both_are_seen():
    assert small("twins", "mapping").scene.mesh_of_face.max() == 1
    take = twins_query(20, 80, 60, 0)
    pictures = [visible_meshes(take.scene, take.camera, pose) for pose in take.cam_from_object]
    counts = np.array([[np.sum(picture == mesh) for mesh in (0, 2)] for picture in pictures])
    assert np.mean(np.all(counts > 100, axis=1)) > 0.7
    assert np.mean(counts[:, 1] > counts[:, 0]) > 0.2
    assert counts[:, 0].min() > 20


def test_the_ambiguous_box_is_mirrored_left_and_right_and_equal_from_behind_but_for_a_label():
    mesh = ambiguous_box(0)
    front, right, back, left, top, bottom = (print_on(mesh, side) for side in range(6))
    assert np.array_equal(right, left[:, ::-1])
    assert np.array_equal(top, top[::-1, ::-1])
    assert np.array_equal(top, bottom)
    rows, columns = (np.flatnonzero((front != back).any(axis=(axis, 2))) for axis in (1, 0))
    assert 0 < np.ptp(rows) * np.ptp(columns) < 0.03 * front.shape[0] * front.shape[1]
    for print_ in (right, top, front):
        assert difference(print_, print_[:, ::-1]) > 15


def test_from_behind_the_ambiguous_box_looks_nearly_as_from_before():
    scene = Scene([ambiguous_box(0)], AMBIENT)
    before, behind = (
        render(scene, CENTERED, look_at(np.array(eye), np.zeros(3)))
        for eye in ((0.0, -0.3, 0.2), (0.0, 0.3, 0.2))
    )
    assert 0.002 < np.mean(np.abs(before.astype(int) - behind).max(axis=2) > 60) < 0.08
