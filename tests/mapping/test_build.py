import shutil

import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.errors import ImageError, InputError, ReconstructionError
from slimsfm.geometry import corner_error, project
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import read_map, write_map
from slimsfm.synthetic.scene import mapping_take


def centres(poses):
    return np.array([pose.inverse().translation for pose in poses])


def assert_points_project_where_they_are_seen(map_, max_error_px):
    for name, seen in map_.observations.items():
        pixels = project(map_.points3D_in_world, map_.images[name].cam_from_world(), map_.camera(name))
        errors = np.linalg.norm(pixels[seen.points] - map_.features[name].keypoints[seen.rows], axis=1)
        assert np.median(errors) < max_error_px
        assert errors.max() < 6


def same_files(one, two):
    names = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    return names == sorted(path.relative_to(two) for path in two.rglob("*") if path.is_file()) and all(
        (one / name).read_bytes() == (two / name).read_bytes() for name in names
    )


def test_images_alone_give_the_true_poses_up_to_a_similarity(unposed, rendered):
    map_ = unposed.build.map
    assert unposed.build.left_out == ()
    assert list(map_.images) == sorted(rendered.names)
    truth = dict(zip(rendered.names, centres(rendered.take.cam_from_object), strict=False))
    true_centres = np.array([truth[name] for name in map_.images])
    found = centres([image.cam_from_world() for image in map_.images.values()])
    object_from_world = pycolmap.estimate_sim3d(found, true_centres)
    errors = np.linalg.norm(object_from_world * found - true_centres, axis=1)
    assert errors.max() < 0.02 * np.linalg.norm(true_centres, axis=1).mean()
    assert_points_project_where_they_are_seen(map_, 0.5)
    assert map_.info.box_source == "estimated"
    assert map_.info.unit == "unknown"
    assert map_.shared_camera is not None
    assert map_.shared_camera.mean_focal_length() == pytest.approx(300, rel=0.2)


def test_known_poses_stay_as_they_are_and_points_lie_on_the_object(posed, rendered):
    map_, known = posed.build.map, rendered.known
    for name, image in map_.images.items():
        assert corner_error(image.cam_from_world(), known.cam_from_world[name], known.box) < 1e-12
        assert np.array_equal(map_.camera(name).params, known.cameras[name].params)
    assert_points_project_where_they_are_seen(map_, 0.5)
    assert len(map_.point3D_ids) > 200
    inside = np.abs((map_.points3D_in_world - map_.box.center) @ np.linalg.inv(map_.box.half_edges))
    assert np.mean((inside < 1.05).all(axis=1)) > 0.9
    assert (map_.info.box_source, map_.info.unit) == ("given", "metre")
    assert map_.box is posed.build.map.info.box


def test_a_built_map_is_sound(posed, unposed):
    for built in (posed, unposed):
        map_ = built.build.map
        assert map_.model.is_valid()
        for name, image in map_.images.items():
            keypoints = np.array([point.xy for point in image.points2D], np.float32)
            assert np.array_equal(keypoints, map_.features[name].keypoints)
        assert map_.colors.std() > 10
        for (a, b), pairs in map_.matches.items():
            assert a < b
            assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) >= 15
            assert pairs[:, 0].max() < len(map_.features[a])
            assert pairs[:, 1].max() < len(map_.features[b])


@pytest.mark.parametrize("kind", ["posed", "unposed"])
def test_building_twice_gives_equal_files(kind, request, rendered, tmp_path):
    first = request.getfixturevalue(kind).build.map
    known = rendered.known if kind == "posed" else None
    again = build_map(rendered.folder, tmp_path / "workspace", BuildOptions(), known).map
    write_map(first, tmp_path / "a")
    write_map(again, tmp_path / "b")
    assert same_files(tmp_path / "a", tmp_path / "b")


def test_a_workspace_can_be_used_again(rendered, posed, tmp_path):
    names = rendered.names[:3]
    shutil.copytree(posed.workspace, tmp_path / "workspace")
    known = rendered.known
    few = type(known)(
        cameras={n: known.cameras[n] for n in names},
        cam_from_world={n: known.cam_from_world[n] for n in names},
        box=known.box,
        unit="metre",
    )
    one, two = (
        build_map(rendered.folder, tmp_path / workspace, BuildOptions(), few).map
        for workspace in ("workspace", "fresh")
    )
    write_map(one, tmp_path / "one")
    write_map(two, tmp_path / "two")
    assert same_files(tmp_path / "one", tmp_path / "two")


def test_masks_keep_features_off_the_background(rendered, tmp_path):
    mask = np.zeros((240, 320), np.uint8)
    mask[60:180, 100:220] = 255
    masks = tmp_path / "masks"
    for name in rendered.names[1:]:
        (masks / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(masks / f"{name}.png")
    build = build_map(rendered.folder, tmp_path / "w", BuildOptions(masks=masks), rendered.known)
    for name in rendered.names[1:]:
        columns, rows = build.map.features[name].keypoints.astype(int).T
        assert (mask[rows, columns] > 0).all()
        assert len(rows) > 20
    columns, rows = build.map.features[rendered.names[0]].keypoints.astype(int).T
    assert (mask[rows, columns] == 0).any()


def test_masks_that_cannot_be_used_are_named(rendered, tmp_path):
    with pytest.raises(InputError, match="no such folder of masks"):
        build_map(rendered.folder, tmp_path / "w", BuildOptions(masks=tmp_path / "missing"), rendered.known)
    path = tmp_path / "masks" / f"{rendered.names[0]}.png"
    path.parent.mkdir(parents=True)
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(path)
    with pytest.raises(ImageError, match=r"frame 0\.png\.png: the mask is \(32, 24\) pixels.*\(320, 240\)"):
        build_map(rendered.folder, tmp_path / "w", BuildOptions(masks=tmp_path / "masks"), rendered.known)


def test_images_that_fit_nowhere_are_left_out_and_named(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    Image.fromarray(noise).save(folder / "noise.png", compress_level=1)
    Image.fromarray(np.zeros_like(noise)).save(folder / "black.png")
    build = build_map(folder, tmp_path / "workspace", BuildOptions(max_features=500))
    assert build.left_out == ("black.png", "noise.png")
    assert list(build.map.images) == sorted(rendered.names)
    write_map(build.map, tmp_path / "map")


def test_images_that_match_each_other_but_not_the_model_are_left_out_with_their_matches(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    other = mapping_take("can", 80, 320, 240, 0)
    for i in range(2):
        Image.fromarray(other.frame(i)).save(folder / f"a can {i}.png", compress_level=1)
    build = build_map(folder, tmp_path / "workspace", BuildOptions(), None)
    assert build.left_out == ("a can 0.png", "a can 1.png")
    write_map(build.map, tmp_path / "map")
    assert list(read_map(tmp_path / "map").matches) == list(build.map.matches)
    assert {name for pair in build.map.matches for name in pair} == set(build.map.images)


def test_options_reach_the_extractor_and_the_cameras(rendered, tmp_path):
    options = BuildOptions(max_features=150, camera="per-image", pairs="sequential", box=None)
    map_ = build_map(rendered.folder, tmp_path / "w", options).map
    assert all(len(map_.features[name]) <= 150 for name in map_.images)
    assert map_.info.extractor_options["max_features"] == 150
    assert map_.shared_camera is None


def test_a_given_box_is_taken(rendered, tmp_path):
    np.savetxt(tmp_path / "box3d_corners.txt", rendered.known.box.corners)
    options = BuildOptions(box=tmp_path / "box3d_corners.txt")
    map_ = build_map(rendered.folder, tmp_path / "w", options, rendered.known).map
    assert map_.info.box_source == "given"
    assert map_.box.diagonal == pytest.approx(rendered.known.box.diagonal)
    with pytest.raises(InputError, match="no such box file"):
        build_map(rendered.folder, tmp_path / "w", BuildOptions(box=tmp_path / "missing.txt"))


def test_too_few_images_are_an_input_error(rendered, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    with pytest.raises(InputError, match="contains no image"):
        build_map(folder, tmp_path / "w")
    shutil.copy(rendered.folder / rendered.names[0], folder / "only.png")
    with pytest.raises(InputError, match="holds 1 image; a map needs at least two"):
        build_map(folder, tmp_path / "w")


def test_images_without_anything_in_common_are_a_reconstruction_error(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 256, (60, 80, 3)).astype(np.uint8)
        Image.fromarray(noise).save(folder / f"{seed}.png")
    with pytest.raises(ReconstructionError, match="no model could be reconstructed from these 3 images"):
        build_map(folder, tmp_path / "w")


def test_an_unreadable_or_missing_image_is_named(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    path = folder / rendered.names[2]
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ImageError, match=r"frame 2\.png: not a readable image"):
        build_map(folder, tmp_path / "w")
    path.unlink()
    with pytest.raises(ImageError, match=r"frame 2\.png: no such image"):
        build_map(folder, tmp_path / "w", BuildOptions(), rendered.known)


def test_wrong_poses_give_no_point(rendered, tmp_path):
    known = rendered.known
    away = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, np.pi / 2, 0])), np.zeros(3))
    turned = {
        name: away * pose if i % 2 else pose for i, (name, pose) in enumerate(known.cam_from_world.items())
    }
    names = [rendered.names[0], rendered.names[1]]
    wrong = type(known)(
        cameras={n: known.cameras[n] for n in names},
        cam_from_world={n: turned[n] for n in names},
        box=known.box,
        unit="metre",
    )
    with pytest.raises(ReconstructionError, match="are these the poses of these images"):
        build_map(rendered.folder, tmp_path / "w", BuildOptions(), wrong)
