import logging
import shutil
import tempfile

import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.errors import ImageError, InputError, ReconstructionError
from slimsfm.geometry import corner_error, project
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.sfm import colmap_warnings
from slimsfm.synthetic.scene import mapping_take


def centers(poses):
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
    map_ = unposed.map
    assert unposed.map.unregistered == ()
    assert list(map_.images) == sorted(rendered.names)
    truth = dict(zip(rendered.names, centers(rendered.take.cam_from_object), strict=False))
    true_centers = np.array([truth[name] for name in map_.images])
    found = centers([image.cam_from_world() for image in map_.images.values()])
    object_from_world = pycolmap.estimate_sim3d(found, true_centers)
    errors = np.linalg.norm(object_from_world * found - true_centers, axis=1)
    assert errors.max() < 0.02 * np.linalg.norm(true_centers, axis=1).mean()
    assert_points_project_where_they_are_seen(map_, 0.5)
    assert map_.info.box_source == "estimated"
    assert map_.info.unit == "unknown"
    assert map_.shared_camera is not None
    assert map_.shared_camera.mean_focal_length() == pytest.approx(300, rel=0.2)


def test_known_poses_stay_as_they_are_and_points_lie_on_the_object(posed, rendered):
    map_, known = posed.map, rendered.known
    for name, image in map_.images.items():
        assert corner_error(image.cam_from_world(), known.cam_from_world[name], known.box) < 1e-12
        assert np.array_equal(map_.camera(name).params, known.cameras[name].params)
    assert_points_project_where_they_are_seen(map_, 0.5)
    assert len(map_.point3D_ids) > 200
    inside = np.abs((map_.points3D_in_world - map_.box.center) @ np.linalg.inv(map_.box.half_edges))
    assert np.mean((inside < 1.05).all(axis=1)) > 0.9
    assert (map_.info.box_source, map_.info.unit) == ("given", "metre")
    assert map_.box is posed.map.info.box


def test_a_built_map_is_consistent(posed, unposed):
    for built in (posed, unposed):
        map_ = built.map
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
    first = request.getfixturevalue(kind).map
    known = rendered.known if kind == "posed" else None
    again = build_map(rendered.folder, known=known)
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
        build_map(rendered.folder, known=few, workspace=tmp_path / workspace)
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
    map_ = build_map(rendered.folder, BuildOptions(masks=masks), known=rendered.known)
    for name in rendered.names[1:]:
        columns, rows = map_.features[name].keypoints.astype(int).T
        assert (mask[rows, columns] > 0).all()
        assert len(rows) > 20
    columns, rows = map_.features[rendered.names[0]].keypoints.astype(int).T
    assert (mask[rows, columns] == 0).any()


def test_masks_that_cannot_be_used_are_named(rendered, tmp_path):
    with pytest.raises(InputError, match="no such folder of masks"):
        build_map(rendered.folder, BuildOptions(masks=tmp_path / "missing"), known=rendered.known)
    path = tmp_path / "masks" / f"{rendered.names[0]}.png"
    path.parent.mkdir(parents=True)
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(path)
    options = BuildOptions(masks=tmp_path / "masks", strict=True)
    told = r"frame 0\.png: its mask .*frame 0\.png\.png: the mask is \(32, 24\) pixels.*\(320, 240\)"
    with pytest.raises(ImageError, match=told):
        build_map(rendered.folder, options, known=rendered.known)


def test_images_that_cannot_be_registered_are_named(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    Image.fromarray(noise).save(folder / "noise.png", compress_level=1)
    Image.fromarray(np.zeros_like(noise)).save(folder / "black.png")
    map_ = build_map(folder, BuildOptions(max_features=500))
    assert map_.unregistered == ("black.png", "noise.png")
    assert list(map_.images) == sorted(rendered.names)
    write_map(map_, tmp_path / "map")


def test_images_that_match_only_each_other_are_not_registered_and_their_matches_dropped(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    other = mapping_take("can", 80, 320, 240, 0)
    for i in range(2):
        Image.fromarray(other.frame(i)).save(folder / f"a can {i}.png", compress_level=1)
    map_ = build_map(folder)
    assert map_.unregistered == ("a can 0.png", "a can 1.png")
    write_map(map_, tmp_path / "map")
    assert list(read_map(tmp_path / "map").matches) == list(map_.matches)
    assert {name for pair in map_.matches for name in pair} == set(map_.images)


def test_options_reach_the_extractor_and_the_cameras(rendered):
    options = BuildOptions(max_features=150, camera="per-image", pairs="sequential", box=None)
    map_ = build_map(rendered.folder, options)
    assert all(len(map_.features[name]) <= 150 for name in map_.images)
    assert map_.info.extractor_options["max_features"] == 150
    assert map_.shared_camera is None


def test_a_given_box_is_used(rendered, tmp_path):
    np.savetxt(tmp_path / "box3d_corners.txt", rendered.known.box.corners)
    options = BuildOptions(box=tmp_path / "box3d_corners.txt")
    map_ = build_map(rendered.folder, options, known=rendered.known)
    assert map_.info.box_source == "given"
    assert map_.box.diagonal == pytest.approx(rendered.known.box.diagonal)
    with pytest.raises(InputError, match="there is no such file"):
        build_map(rendered.folder, BuildOptions(box=tmp_path / "missing.txt"))


def test_too_few_images_are_an_input_error(rendered, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    with pytest.raises(InputError, match="contains no image"):
        build_map(folder)
    shutil.copy(rendered.folder / rendered.names[0], folder / "only.png")
    with pytest.raises(InputError, match="holds 1 image; a map needs at least two"):
        build_map(folder)


def test_images_without_anything_in_common_are_a_reconstruction_error(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 256, (60, 80, 3)).astype(np.uint8)
        Image.fromarray(noise).save(folder / f"{seed}.png")
    with pytest.raises(
        ReconstructionError, match=r"these 3 photos give no model.*3 of 3 photos are almost without texture"
    ):
        build_map(folder)


def test_wrong_poses_give_no_point(rendered):
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
        build_map(rendered.folder, known=wrong)


def test_without_a_workspace_nothing_is_left_on_disk_and_the_map_still_has_its_features(
    rendered, posed, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    map_ = build_map(str(rendered.folder), known=rendered.known)
    assert list(tmp_path.iterdir()) == []
    for name in rendered.names:
        assert np.array_equal(map_.features[name].descriptors, posed.map.features[name].descriptors)


def test_a_given_workspace_keeps_database_features_and_model(posed):
    assert {"database.db", "features.h5", "sfm"} <= {path.name for path in posed.workspace.iterdir()}


def test_building_prints_nothing(rendered, capfd, caplog):
    build_map(rendered.folder)
    assert capfd.readouterr() == ("", "")
    assert caplog.messages == []


def test_each_warning_of_colmap_is_passed_on_once(capfd, caplog):
    before = pycolmap.logging.minloglevel
    with caplog.at_level(logging.WARNING), colmap_warnings():
        pycolmap.logging.info("not important")
        for _ in range(3):
            pycolmap.logging.warning("poor focal length")
        pycolmap.logging.error("bad pair")
        pycolmap.logging.warning('Could not read image 119 at path "/tmp/sfm/119"')
    assert sorted(caplog.messages) == ["COLMAP: bad pair", "COLMAP: poor focal length (3 times)"]
    assert capfd.readouterr().err == ""
    assert pycolmap.logging.minloglevel == before


def test_progress_counts_images_pairs_and_registered_images(rendered):
    done = []

    def record(items, label):
        for number, item in enumerate(items):
            yield item
            done.append((label, number + 1, len(items)))

    build_map(rendered.folder, progress=record)
    last = {label: (number, total) for label, number, total in done}
    assert last == {"extract features": (8, 8), "match pairs": (28, 28), "register images": (8, 8)}


def test_reconstruction_says_that_it_goes_on_globally(rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 256, (240, 320, 3)).astype(np.uint8)
        Image.fromarray(noise).save(folder / f"noise {seed}.png")
    labels = []

    def record(items, label):
        labels.append(label)
        return iter(items)

    map_ = build_map(folder, BuildOptions(max_features=500), progress=record)
    assert labels == ["extract features", "match pairs", "register images", "reconstruct globally"]
    assert map_.unregistered == ("noise 0.png", "noise 1.png", "noise 2.png")
