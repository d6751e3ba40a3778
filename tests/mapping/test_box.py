import json

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from scenes import BOX, camera, poses
from slimsfm.errors import InputError
from slimsfm.geometry import Box, project
from slimsfm.mapping.model import estimate_box, read_box
from slimsfm.synthetic.scene import look_at


def write_json(path, value):
    path.write_text(json.dumps(value))


@pytest.mark.parametrize("form", ["list", "object", "onepose"])
def test_a_box_is_read_in_every_form(tmp_path, form):
    path = tmp_path / ("box3d_corners.txt" if form == "onepose" else "box.json")
    corners = BOX.corners[[3, 0, 7, 1, 2, 6, 5, 4]]
    if form == "onepose":
        np.savetxt(path, corners)
    else:
        write_json(path, corners.tolist() if form == "list" else {"corners": corners.tolist()})
    read = read_box(path).corners
    assert np.array(sorted(read.round(9).tolist())) == pytest.approx(np.array(sorted(BOX.corners.tolist())))


@pytest.mark.parametrize("name", ["box3d_corners.txt", "box.json"])
def test_a_box_may_start_with_a_byte_order_mark(tmp_path, name):
    rows = BOX.corners.tolist()
    text = json.dumps(rows) if name == "box.json" else "\n".join(" ".join(map(str, row)) for row in rows)
    (tmp_path / name).write_text(text, "utf-8-sig")
    assert np.array_equal(read_box(tmp_path / name).corners, Box.from_corners(BOX.corners).corners)


SEVEN = BOX.corners[:7].tolist()
SKEWED = (BOX.corners * [[3.0]] + np.eye(8, 3)).tolist()


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", "3", '{"corners": null}', '{"box": 1}', '[["a", "b", "c"]]'),
        *("[[1, 2], [3]]", "[[1e999, 0, 0]]"),
        *(json.dumps(corners) for corners in (SEVEN, SKEWED, [[0, 0, 0]] * 8)),
    ],
)
def test_json_without_a_box_is_an_input_error(tmp_path, text):
    (tmp_path / "box.json").write_text(text)
    with pytest.raises(InputError, match=r"box\.json: must hold the 8 corners"):
        read_box(tmp_path / "box.json")


@pytest.mark.parametrize(
    "text", ["", "\n\n", "hello", "1 2 3\n4 5", "1 2 3\n" * 8, "1 2 3\n", "\xff"], ids=repr
)
def test_text_without_a_box_is_an_input_error(tmp_path, text):
    (tmp_path / "box3d_corners.txt").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"box3d_corners\.txt: must hold the 8 corners"):
        read_box(tmp_path / "box3d_corners.txt")


def test_a_missing_box_and_a_folder_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_box(tmp_path / "box.json")
    with pytest.raises(InputError, match="must hold"):
        read_box(tmp_path)


def scene(background, seed=0, world_from_box=None):
    """A model of an object on a large ground plane; a share of its points lies around the object."""
    rng = np.random.default_rng(seed)
    on_object = rng.uniform(-1, 1, (400, 3))
    on_object[np.arange(400), rng.integers(0, 3, 400)] = rng.choice([-1.0, 1.0], 400)  # the surface
    count = round(400 * background / (1 - background))
    around = np.column_stack([rng.uniform(-6, 6, (count, 2)), np.full(count, -0.6)])
    points = np.concatenate([on_object @ BOX.half_edges, around])
    world = world_from_box or pycolmap.Rigid3d()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera())
    tracks = [pycolmap.Track() for _ in points]
    for image_id, cam_from_box in enumerate(poses(12), start=1):
        pixels = project(points, cam_from_box, camera())
        seen = np.flatnonzero(np.all((pixels > 0) & (pixels < (640, 480)), axis=1))
        image = pycolmap.Image(name=f"{image_id}.png", keypoints=pixels[seen], camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, cam_from_box * world.inverse())
        for row, point in enumerate(seen):
            tracks[point].add_element(image_id, row)
    for point, track in zip(world * points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize("background", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_the_background_hardly_changes_the_estimated_diagonal(background, seed):
    box = estimate_box(scene(background, seed))
    assert box.diagonal == pytest.approx(BOX.diagonal, rel=0.25)
    assert np.linalg.norm(box.center) < 0.1 * BOX.diagonal


def test_the_box_moves_with_the_model():
    rotation = pycolmap.Rotation3d(Rotation.random(rng=np.random.default_rng(3)).as_quat())
    world_from_box = pycolmap.Rigid3d(rotation, np.array([10.0, -20.0, 5.0]))
    still, moved = estimate_box(scene(0.2)), estimate_box(scene(0.2, world_from_box=world_from_box))
    expected = world_from_box * still.corners
    gaps = np.linalg.norm(moved.corners[:, None] - expected[None], axis=2)
    assert np.array_equal(np.sort(gaps.argmin(axis=1)), np.arange(8))
    assert gaps.min(axis=1).max() < 1e-6


def test_equal_models_give_equal_boxes():
    assert np.array_equal(estimate_box(scene(0.2)).corners, estimate_box(scene(0.2)).corners)


def test_the_box_of_flat_points_has_some_thickness():
    model = scene(0.0)
    for point in model.points3D.values():
        point.xyz = point.xyz * [1, 1, 0]
    box = estimate_box(model)
    assert np.linalg.norm(box.half_edges, axis=1).min() > 0
    assert box.diagonal == pytest.approx(2 * np.hypot(1, 0.8), rel=0.1)


def room(num_cameras, look_out):
    """A room of 6 by 4 by 2.5 units with cameras on a ring in its middle, and some points far outside."""
    rng = np.random.default_rng(0)
    walls = rng.uniform(-1, 1, (1500, 3))
    walls[np.arange(1500), rng.integers(0, 2, 1500)] = rng.choice([-1.0, 1.0], 1500)
    points = np.concatenate([walls * [3, 2, 1.25], rng.uniform(-40, 40, (15, 3))])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera())
    tracks = [pycolmap.Track() for _ in points]
    for image_id in range(1, num_cameras + 1):
        angle = 2 * np.pi * image_id / num_cameras
        center = 0.5 * np.array([np.cos(angle), np.sin(angle), 0])
        pose = look_at(center, center * (3 if look_out else -1))
        pixels = project(points, pose, camera())
        seen = np.flatnonzero(np.all((pixels > 0) & (pixels < (640, 480)), axis=1))
        image = pycolmap.Image(name=f"{image_id}.png", keypoints=pixels[seen], camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
        for row, point in enumerate(seen):
            tracks[point].add_element(image_id, row)
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def test_the_box_of_a_place_is_that_of_what_is_seen_around_the_cameras():
    model = room(40, look_out=True)
    box = estimate_box(model)
    lengths = np.sort(2 * np.linalg.norm(box.half_edges, axis=1))
    assert lengths == pytest.approx([2.5, 4, 6], rel=0.25)
    offsets = [
        np.linalg.solve(box.half_edges.T, model.image(i).projection_center() - box.center)
        for i in range(1, 41)
    ]
    assert np.abs(offsets).max() < 1
