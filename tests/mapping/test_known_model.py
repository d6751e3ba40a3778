"""Maps from known poses: how they were read is checked, and they are adjusted if asked."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pycolmap
import pytest

from slimsfm.errors import InputError
from slimsfm.geometry import rotation_error_deg
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.conventions import CONVENTIONS, agreement, read_rays
from slimsfm.mapping.inputs import InputOptions
from slimsfm.mapping.known_model import triangulate_known
from slimsfm.mapping.workspace import DATABASE


def center(pose):
    return pose.inverse().translation


@pytest.mark.parametrize("written", CONVENTIONS, ids=str)
@pytest.mark.parametrize("read", CONVENTIONS, ids=str)
def test_matches_say_in_which_convention_matrices_were_written(posed, rendered, tmp_path, written, read):
    names = sorted(rendered.names)
    poses = rendered.known.cam_from_world
    wrong = {name: read.cam_from_world(written.matrix(poses[name])) for name in names}
    known = replace(rendered.known, cam_from_world=wrong, convention=read, source="poses.json")
    database = posed.workspace / DATABASE
    if read == written:
        triangulate_known(database, names, tmp_path, known, seed=0)
        assert agreement(read_rays(database, names), poses) > 0.9
        return
    with pytest.raises(InputError) as error:
        triangulate_known(database, names, tmp_path, known, seed=0)
    message = str(error.value)
    assert message.startswith("poses.json: its matrices were read as")
    assert f"do if they are {written}" in message
    assert "\n" not in message


def noisy(known, deviation, degrees):
    rng = np.random.default_rng(0)
    poses = {}
    for name, pose in sorted(known.cam_from_world.items()):
        turn = pycolmap.Rotation3d(np.radians(degrees) * rng.normal(size=3))
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(), -(center(pose) + deviation * rng.normal(size=3)))
        poses[name] = pycolmap.Rigid3d(turn * pose.rotation, np.zeros(3)) * moved
    return replace(known, cam_from_world=poses)


def test_refining_brings_poses_nearer_to_the_truth_in_the_same_frame_and_unit(posed, rendered, tmp_path):
    names, truth = sorted(rendered.names), rendered.known.cam_from_world
    spread = np.std([center(pose) for pose in truth.values()], axis=0).max()
    known = replace(noisy(rendered.known, 0.005 * spread, 0.2), refine=True)
    made = triangulate_known(posed.workspace / DATABASE, names, tmp_path, known, seed=0)
    again = triangulate_known(posed.workspace / DATABASE, names, tmp_path, known, seed=0)
    poses = {image.name: image.cam_from_world() for image in made.model.images.values()}
    both = poses, known.cam_from_world
    relative = [
        [rotation_error_deg(one[b] * one[a].inverse(), truth[b] * truth[a].inverse()) for one in both]
        for a, b in pairwise(names)
    ]
    after, before = np.median(relative, axis=0)
    assert after < before / 2
    moved = [np.linalg.norm(center(poses[name]) - center(known.cam_from_world[name])) for name in names]
    assert max(moved) < 0.05 * spread
    assert made.notes[0].startswith("poses adjusted to the matches: cameras moved by")
    assert again.notes == made.notes


def test_poses_of_a_file_give_the_map_of_the_same_poses_in_python(rendered, posed, tmp_path):
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(rendered.take.camera.todict())
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for i, (name, pose) in enumerate(rendered.known.cam_from_world.items(), start=1):
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=i), pose)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    inputs = InputOptions(poses=tmp_path / "sparse", unit="metre")
    made = build_map(rendered.folder, BuildOptions(), inputs=inputs)
    assert made.info.unit == "metre"
    assert made.info.box_source == "estimated"
    assert sorted(made.images) == sorted(posed.map.images)
    assert made.model.num_points3D() == pytest.approx(posed.map.model.num_points3D(), rel=0.02)
    for name, image in made.images.items():
        assert np.allclose(image.cam_from_world().matrix(), rendered.known.cam_from_world[name].matrix())


def test_options_about_poses_need_poses(rendered):
    with pytest.raises(ValueError, match="unit is about known poses"):
        InputOptions(unit="metre")
    with pytest.raises(ValueError, match="refine is about known poses"):
        InputOptions(refine=True)
    with pytest.raises(ValueError, match="given twice"):
        build_map(rendered.folder, inputs=InputOptions(poses=rendered.folder), known=rendered.known)
