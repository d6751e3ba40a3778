"""Models for the page: read from files as people have them, and placed in a map."""

import base64
import io
import json

import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image

from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.serve.models import read_anchor, read_model
from slimsfm.synthetic.objects import OBJECTS

BOX = Box(np.array([1.0, 2.0, 3.0]), np.diag([0.1, 0.2, 0.3]))


@pytest.fixture(scope="module")
def mesh():
    return OBJECTS["plain_box"](0)


def colored():
    cube = trimesh.creation.box((1, 1, 1))
    cube.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (8, 4), dtype=np.uint8)
    return cube


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_textured_model_keeps_its_shape_and_texture(mesh, tmp_path, suffix):
    path = tmp_path / f"thing.{suffix}"
    mesh.export(path)
    model = read_model(path, BOX, pycolmap.Sim3d())
    np.testing.assert_allclose(model.positions.min(axis=0), mesh.bounds[0], atol=1e-6)
    np.testing.assert_allclose(model.positions.max(axis=0), mesh.bounds[1], atol=1e-6)
    assert len(model.triangles) == len(mesh.faces)
    assert model.texture is not None
    original = np.asarray(mesh.visual.material.image.convert("RGB").resize((8, 32)), dtype=float)
    read = np.asarray(model.texture.resize((8, 32)), dtype=float)
    assert np.abs(original - read).mean() < 3
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1, atol=1e-6)


def test_a_model_with_colors_keeps_them(tmp_path):
    colored().export(tmp_path / "cube.ply")
    model = read_model(tmp_path / "cube.ply", BOX)
    assert model.texture is None
    np.testing.assert_allclose(model.colors, colored().visual.vertex_colors[:, :3] / 255, atol=1e-6)


def test_parts_with_and_without_texture_become_one_mesh(mesh, tmp_path):
    trimesh.Scene([mesh, colored().apply_translation((2, 0, 0))]).export(tmp_path / "two.glb")
    model = read_model(tmp_path / "two.glb", BOX)
    assert model.texture is not None
    assert len(model.positions) == len(model.uvs) == len(model.colors) == len(model.normals)
    assert len(np.unique(np.round(model.colors, 3), axis=0)) >= 8
    assert model.triangles.max() < len(model.positions)


def test_a_model_fills_the_box_unless_it_has_an_anchor(mesh, tmp_path):
    mesh.export(tmp_path / "thing.glb")
    placed = read_model(tmp_path / "thing.glb", BOX).positions
    low, high = placed.min(axis=0), placed.max(axis=0)
    np.testing.assert_allclose((low + high) / 2, BOX.center, atol=1e-6)
    assert np.linalg.norm(high - low) == pytest.approx(BOX.diagonal)
    anchor = pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0, 0, np.pi / 2])), np.array([1.0, 0, 0]))
    turned = read_model(tmp_path / "thing.glb", BOX, anchor)
    plain = read_model(tmp_path / "thing.glb", BOX, pycolmap.Sim3d())
    np.testing.assert_allclose(turned.positions, anchor * plain.positions, atol=1e-9)
    np.testing.assert_allclose(turned.normals, plain.normals @ anchor.rotation.matrix().T, atol=1e-9)


def test_the_answer_is_flat_lists_and_a_data_uri(mesh, tmp_path):
    mesh.export(tmp_path / "thing.glb")
    model = read_model(tmp_path / "thing.glb", BOX)
    answer = json.loads(json.dumps(model.to_json(), allow_nan=False))
    np.testing.assert_allclose(answer["positions"], model.positions.ravel(), rtol=1e-5, atol=1e-9)
    assert len(answer["indices"]) == 3 * len(model.triangles)
    data = base64.b64decode(answer["texture"].removeprefix("data:image/png;base64,"))
    with Image.open(io.BytesIO(data)) as image:
        assert max(image.size) <= 2048


PLY = b"ply\nformat ascii 1.0\nelement vertex 9999999999\nproperty float x\nend_header\n"


@pytest.mark.parametrize("data", [b"", b"glTF", b"text" * 100, PLY], ids=["empty", "cut", "text", "lying"])
@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_damaged_models_are_named_in_one_line(tmp_path, suffix, data):
    path = tmp_path / f"bad.{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"bad\.{suffix}: ") as raised:
        read_model(path, BOX)
    assert "\n" not in str(raised.value)


def test_other_formats_missing_files_and_points_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"a model must be one of \.glb, \.obj, \.ply"):
        read_model(tmp_path / "thing.fbx", BOX)
    with pytest.raises(InputError, match=r"thing\.glb: no such model"):
        read_model(tmp_path / "thing.glb", BOX)
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(InputError, match=r"points\.ply: has no triangles"):
        read_model(tmp_path / "points.ply", BOX)


def test_models_with_too_many_triangles_are_refused(tmp_path):
    trimesh.creation.icosphere(subdivisions=7).export(tmp_path / "fine.ply")
    with pytest.raises(InputError, match=r"fine\.ply: has 327680 triangles, more than 200000"):
        read_model(tmp_path / "fine.ply", BOX)


def test_anchors_are_read(tmp_path):
    path = tmp_path / "anchor.json"
    path.write_text('{"scale": 2, "translation": [1, 2, 3], "quaternion_xyzw": [0, 0, 2, 0]}')
    anchor = read_anchor(path)
    assert anchor.scale == 2
    np.testing.assert_allclose(anchor * np.array([[1.0, 0, 0]]), [[-1, 2, 3]], atol=1e-12)
    path.write_text("{}")
    np.testing.assert_allclose(read_anchor(path).matrix(), np.eye(4)[:3])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"scale": 0}',
        '{"scale": "x"}',
        '{"translation": [1, 2]}',
        '{"quaternion_xyzw": [0, 0, 0, 0]}',
    ],
)
def test_wrong_anchors_are_named(tmp_path, text):
    path = tmp_path / "anchor.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"anchor\.json: not an anchor"):
        read_anchor(path)
