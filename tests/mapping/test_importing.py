import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.errors import ImageError, InputError, ModelError
from slimsfm.features import unit_rows
from slimsfm.localization.localizer import Localizer
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.io import read_map, write_map
from slimsfm.photos import read_image
from slimsfm.synthetic.scene import mapping_take


def write_colmap_database(path, map_):
    """The database that COLMAP would have left next to the model."""
    with pycolmap.Database.open(path) as database:
        for camera in map_.model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for name, image in map_.images.items():
            row = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
            database.write_image(row, use_image_id=True)
            one = map_.features[name]
            database.write_keypoints(image.image_id, np.hstack([one.keypoints, one.frames]))
            descriptors = pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=map_.features[name].descriptors
            )
            database.write_descriptors(image.image_id, descriptors)
        for (a, b), pairs in map_.matches.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = pairs.astype(np.uint32)
            database.write_two_view_geometry(map_.images[a].image_id, map_.images[b].image_id, geometry)


def rows_of(database):
    with closing(sqlite3.connect(database)) as opened:
        return list(opened.iterdump())


def write_hloc(folder, map_, wrong=0):
    """Features and matches as hloc writes them, half precision, with some wrong matches."""
    rng = np.random.default_rng(0)
    with h5py.File(folder / "features.h5", "w") as file:
        for name in map_.images:
            one, group = map_.features[name], file.create_group(name)
            group["keypoints"] = one.keypoints - 0.5
            group["descriptors"] = unit_rows(one.descriptors).astype(np.float16).T
            group["scores"] = one.scores.astype(np.float16)
            group["image_size"] = np.array(one.image_size)
    with h5py.File(folder / "matches.h5", "w") as file:
        for (a, b), pairs in map_.matches.items():
            targets = np.full(len(map_.features[a]), -1, np.int16)
            targets[rng.integers(0, len(targets), wrong)] = rng.integers(0, len(map_.features[b]), wrong)
            targets[pairs[:, 0]] = pairs[:, 1]
            file[f"{a.replace('/', '-')}/{b.replace('/', '-')}/matches0"] = targets


@dataclass(frozen=True)
class Project:
    """The COLMAP project of a built map: model, database and hloc's files."""

    folder: Path
    model: Path


@pytest.fixture(scope="session")
def project(posed, tmp_path_factory) -> Project:
    folder = tmp_path_factory.mktemp("project")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    posed.map.model.write_binary(model)
    write_colmap_database(folder / "database.db", posed.map)
    write_hloc(folder, posed.map, wrong=60)
    return Project(folder, model)


@pytest.fixture
def editable(project, tmp_path) -> Project:
    shutil.copytree(project.folder, tmp_path / "project")
    return Project(tmp_path / "project", tmp_path / "project" / "sparse" / "0")


def poses_of_queries(map_):
    localizer = Localizer(map_)
    between = mapping_take("printed_box", 90, 320, 240, 0)  # the same object, other views
    found = []
    for index in (3, 5):
        pose = localizer.localize(between.frame(index)).pose
        assert pose is not None
        found.append(pose.cam_from_world.matrix())
    return np.array(found)


@pytest.mark.parametrize("kind", ["new binary", "new text", "old binary", "old text"])
def test_an_imported_model_localizes_like_the_map_that_it_came_from(project, posed, tmp_path, kind):
    model = tmp_path / "model"
    model.mkdir()
    original = posed.map
    (original.model.write_text if "text" in kind else original.model.write_binary)(model)
    if "old" in kind:
        for path in [*model.glob("rigs.*"), *model.glob("frames.*")]:
            path.unlink()
    map_ = import_colmap(model, options=ImportOptions(database=project.folder / "database.db"))
    assert list(map_.images) == list(original.images)
    assert np.array_equal(map_.point3D_ids, original.point3D_ids)
    assert np.array_equal(map_.points3D_in_world, original.points3D_in_world)
    assert list(map_.matches) == list(original.matches)
    for pair, pairs in original.matches.items():
        assert np.array_equal(map_.matches[pair], pairs)
    for name in original.images:
        assert np.array_equal(map_.features[name].descriptors, original.features[name].descriptors)
        assert np.array_equal(map_.features[name].keypoints, original.features[name].keypoints)
        assert map_.features[name].image_size == (320, 240)
    expected = poses_of_queries(original)
    # Text holds unit quaternions that are not quite, so that poses differ in the last digit.
    assert poses_of_queries(map_) == pytest.approx(expected, abs=1e-6 if "text" in kind else 0)
    write_map(map_, tmp_path / "map")
    assert np.array_equal(poses_of_queries(read_map(tmp_path / "map")), poses_of_queries(map_))


def test_the_database_is_found_where_colmap_puts_it_and_not_changed(editable):
    before = rows_of(editable.folder / "database.db")
    map_ = import_colmap(editable.model)
    assert len(map_.matches) > 5
    assert map_.info.box_source == "estimated"
    assert "database" in map_.info.origin
    assert rows_of(editable.folder / "database.db") == before
    assert [path.name for path in editable.folder.glob("database*")] == ["database.db"]


def test_without_a_database_the_error_names_other_sources(editable):
    (editable.folder / "database.db").unlink()
    with pytest.raises(
        InputError, match=r"no database\.db next to the model.*database=FILE.*features=FILE.*images=DIR"
    ):
        import_colmap(editable.model)
    with pytest.raises(InputError, match="no such database"):
        import_colmap(editable.model, options=ImportOptions(database=editable.folder / "database.db"))


@pytest.mark.parametrize("damage", ["text", "cut", "empty", "other"])
def test_a_damaged_database_is_an_input_error(editable, damage):
    path = editable.folder / "database.db"
    whole = path.read_bytes()
    path.write_bytes({"text": b"hello", "cut": whole[:20_000], "empty": b"", "other": whole[:100]}[damage])
    with pytest.raises(InputError, match=r"database\.db"):
        import_colmap(editable.model)


def test_a_database_of_other_images_is_a_model_error(editable, posed):
    path = editable.folder / "database.db"
    path.unlink()
    with pycolmap.Database.open(path) as database:
        database.write_camera(posed.map.shared_camera)
    with pytest.raises(ModelError, match=r"database\.db: has no features of all 8 images of the model"):
        import_colmap(editable.model)


def test_features_of_another_run_are_a_model_error(editable):
    path = editable.folder / "features.h5"
    with h5py.File(path, "r+") as file:
        group = file["take 1/frame 3.png"]
        for part in ("keypoints", "scores"):
            shorter = group[part][:-1]
            del group[part]
            group[part] = shorter
        shorter = group["descriptors"][:, :-1]
        del group["descriptors"]
        group["descriptors"] = shorter
    with pytest.raises(ModelError, match=r"frame 3\.png' has \d+ keypoints in the model but \d+ in the feat"):
        import_colmap(editable.model, options=ImportOptions(features=path))
    with h5py.File(path, "r+") as file:
        del file["take 1/frame 3.png"]
    with pytest.raises(
        ModelError, match=r"features\.h5: has no features of 1 image \('take 1/frame 3\.png'\)"
    ):
        import_colmap(editable.model, options=ImportOptions(features=path))


def test_hloc_files_give_the_same_poses_and_wrong_matches_are_removed(project, posed):
    options = ImportOptions(features=project.folder / "features.h5", matches=project.folder / "matches.h5")
    map_, original = import_colmap(project.model, options=options), posed.map
    for name in original.images:
        assert map_.features[name].descriptors.dtype == np.float16
        assert map_.features[name].keypoints == pytest.approx(original.features[name].keypoints, abs=1e-4)
    found, true = poses_of_queries(map_), poses_of_queries(original)
    assert found == pytest.approx(true, abs=2e-2)  # these features have no scales
    kept = wrong = lost = 0
    for pair, pairs in original.matches.items():
        right = set(map(tuple, pairs.tolist()))
        ours = set(map(tuple, map_.matches[pair].tolist())) if pair in map_.matches else set()
        kept, wrong, lost = kept + len(ours & right), wrong + len(ours - right), lost + len(right - ours)
    assert lost < 0.05 * kept
    # By chance a wrong match lies within the tolerance of its epipolar line; of 60 a pair few do.
    assert wrong < 0.15 * 60 * len(original.matches)


def test_matches_of_missing_keypoints_are_named(editable):
    with h5py.File(editable.folder / "matches.h5", "r+") as file:
        next(iter(next(iter(file.values())).values()))["matches0"][0] = 30_000
    options = ImportOptions(features=editable.folder / "features.h5", matches=editable.folder / "matches.h5")
    with pytest.raises(ModelError, match=r"matches\.h5.*keypoint"):
        import_colmap(editable.model, options=options)


def test_features_without_matches_give_a_map_without_matches(project):
    map_ = import_colmap(project.model, options=ImportOptions(features=project.folder / "features.h5"))
    assert map_.matches == {}


def test_keypoints_are_described_again_from_the_images(project, posed, rendered):
    map_ = import_colmap(project.model, options=ImportOptions(images=rendered.folder))
    cosines = []
    for name, seen in posed.map.observations.items():
        one, two = (unit_rows(m.features[name].descriptors[seen.rows]) for m in (map_, posed.map))
        cosines.append((one * two).sum(axis=1))
    assert np.mean(np.concatenate(cosines) > 0.9) > 0.8
    true = poses_of_queries(posed.map)
    assert poses_of_queries(map_) == pytest.approx(true, abs=0.02)


def test_images_that_are_missing_or_of_another_size_are_named(project, rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    path = folder / rendered.names[2]
    Image.fromarray(read_image(path)[:200]).save(path)
    with pytest.raises(
        ImageError, match=r"frame 2\.png: 320x200 pixels, but its camera in the model has 320x240"
    ):
        import_colmap(project.model, options=ImportOptions(images=folder))
    for name in rendered.names[1:]:
        (folder / name).unlink()
    with pytest.raises(ImageError, match=r"only 1 of the 8 images.*7 photos skipped: .*no such image"):
        import_colmap(project.model, options=ImportOptions(images=folder))
    with pytest.raises(InputError, match="no such folder of images"):
        import_colmap(project.model, options=ImportOptions(images=tmp_path / "missing"))


def test_an_image_whose_photo_cannot_be_read_is_left_out(project, rendered, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(rendered.folder, folder)
    cut, gone, *rest = rendered.names
    (folder / cut).write_bytes((folder / cut).read_bytes()[:5000])
    (folder / gone).unlink()
    whole = import_colmap(project.model, options=ImportOptions(images=rendered.folder))
    made = import_colmap(project.model, options=ImportOptions(images=folder))
    assert list(made.images) == sorted(rest)
    assert made.info.notes[1] == f"1 photo skipped: {gone} (no such image)"
    for name in rest:
        assert np.array_equal(made.features[name].descriptors, whole.features[name].descriptors)
        assert made.images[name].cam_from_world() == whole.images[name].cam_from_world()
    write_map(made, tmp_path / "map")
    assert list(read_map(tmp_path / "map").images) == sorted(rest)


def resized(rendered, folder, factors):
    """A copy of the images whose sides are multiplied by factors."""
    for name in rendered.names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        size = tuple(round(side * factor) for side, factor in zip((320, 240), factors, strict=True))
        Image.fromarray(read_image(rendered.folder / name)).resize(size).save(folder / name)
    return ImportOptions(images=folder)


@pytest.mark.parametrize("factor", [0.5, 2.0, 0.703])
def test_images_that_all_were_resized_alike_are_described(project, posed, rendered, tmp_path, factor):
    map_ = import_colmap(project.model, options=resized(rendered, tmp_path / "images", (factor, factor)))
    described, note = map_.info.notes
    assert "keypoints that see a point; the others match nothing" in described
    assert f"images: the images are {factor:.3g} times as large as those of the model" in note
    for name, one in posed.map.features.items():
        assert np.array_equal(map_.features[name].keypoints, one.keypoints)
        assert map_.features[name].image_size == (320, 240)
    if factor == 0.5:
        assert poses_of_queries(map_) == pytest.approx(poses_of_queries(posed.map), abs=0.05)


@pytest.mark.parametrize("factors", [(0.5, 0.6), (1.0, 0.9), (1.02, 1.02)])
def test_images_of_other_proportions_are_an_error_that_names_the_ratio(project, rendered, tmp_path, factors):
    with pytest.raises(ImageError, match=r"frame 0\.png.* times the width, .* times the height") as error:
        import_colmap(project.model, options=resized(rendered, tmp_path / "images", factors))
    assert f"{round(320 * factors[0]) / 320:.4g} times the width" in str(error.value)


def test_images_resized_by_different_factors_are_an_error(project, rendered, tmp_path):
    options = resized(rendered, tmp_path / "images", (0.5, 0.5))
    path = tmp_path / "images" / rendered.names[5]
    Image.fromarray(read_image(rendered.folder / rendered.names[5])).resize((240, 180)).save(path)
    with pytest.raises(ImageError, match=r"frame 5\.png: 240x180 pixels.*\(0\.75 times"):
        import_colmap(project.model, options=options)


def swap(folder, names):
    first, second = (folder / name for name in (names[1], names[6]))
    one, other = first.read_bytes(), second.read_bytes()
    first.write_bytes(other)
    second.write_bytes(one)
    return [names[1], names[6]]


def turn(folder, names):
    for name in names[::3]:
        Image.fromarray(read_image(folder / name)[::-1, ::-1]).save(folder / name)
    return names[::3]


def mirror(folder, names):
    Image.fromarray(read_image(folder / names[2])[:, ::-1]).save(folder / names[2])
    return names[2:3]


@pytest.mark.parametrize("change", [swap, turn, mirror])
def test_photos_that_are_not_the_models_are_all_named(project, rendered, tmp_path, change):
    shutil.copytree(rendered.folder, tmp_path / "images")
    wrong = change(tmp_path / "images", rendered.names)
    with pytest.raises(ModelError) as error:
        import_colmap(project.model, options=ImportOptions(images=tmp_path / "images"))
    assert [name for name in rendered.names if repr(name) in str(error.value)] == sorted(wrong)


def test_images_of_something_else_are_a_model_error(project, rendered, tmp_path):
    for name in rendered.names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((240, 320, 3), 90, np.uint8)).save(tmp_path / name)
    with pytest.raises(ModelError, match=r"at only 0 of the .* keypoints"):
        import_colmap(project.model, options=ImportOptions(images=tmp_path))


def test_a_model_without_points_is_a_model_error(project, tmp_path):
    model = pycolmap.Reconstruction(project.model)
    for i in list(model.point3D_ids()):
        model.delete_point3D(i)
    model.write_binary(tmp_path)
    with pytest.raises(ModelError, match="no 3D points; triangulate it first"):
        import_colmap(tmp_path, options=ImportOptions(database=project.folder / "database.db"))


def test_a_given_box_is_used(project, rendered, tmp_path):
    np.savetxt(tmp_path / "box3d_corners.txt", rendered.known.box.corners)
    map_ = import_colmap(project.model, options=ImportOptions(box=tmp_path / "box3d_corners.txt"))
    assert map_.info.box_source == "given"
    assert map_.box.diagonal == pytest.approx(rendered.known.box.diagonal)


def test_two_sources_of_descriptors_are_refused():
    path = Path("x")
    with pytest.raises(ValueError, match="database and images: give only one"):
        ImportOptions(database=path, images=path)
    with pytest.raises(ValueError, match="matches needs features"):
        ImportOptions(matches=path)


def replace_keypoints(path, map_, columns):
    """Give the keypoints of a database more columns, the same for every image."""
    with pycolmap.Database.open(path) as database:
        for name, image in map_.images.items():
            keypoints = map_.features[name].keypoints
            rows = np.resize(columns, (len(keypoints), columns.shape[1])).astype(np.float32)
            database.update_keypoints(image.image_id, np.hstack([keypoints, rows]))


@pytest.mark.parametrize("form", ["affine shapes", "scales and orientations", "positions"])
def test_scales_and_orientations_of_a_database_are_read_as_colmap_reads_them(editable, posed, form):
    read = pycolmap.FeatureKeypoint.from_shape_parameters
    made = [read(10.0 + i, 20.0, 1.5 + i, 2.0 + i, 0.4 * i, 0.1) for i in range(5)]
    expected = np.array([(k.compute_scale(), k.compute_orientation()) for k in made])
    columns = {
        "affine shapes": np.array([(k.a11, k.a12, k.a21, k.a22) for k in made]),
        "scales and orientations": expected,
        "positions": np.zeros((5, 0)),
    }[form]
    replace_keypoints(editable.folder / "database.db", posed.map, columns)
    map_ = import_colmap(editable.model)
    for name in posed.map.images:
        frames = map_.features[name].frames
        if form == "positions":
            assert frames is None
        else:
            assert np.allclose(frames, np.resize(expected, frames.shape), atol=1e-5)


def test_images_can_be_named_directly(project, rendered):
    map_ = import_colmap(str(project.model), images=str(rendered.folder))
    by_options = import_colmap(project.model, options=ImportOptions(images=rendered.folder))
    assert map_.fingerprint == by_options.fingerprint
    with pytest.raises(ValueError, match="database and images: give only one"):
        import_colmap(project.model, rendered.folder, ImportOptions(database=project.folder / "database.db"))


def all_features(path):
    return ImportOptions(features=path / "features.h5", matches=path / "matches.h5")


def each_group(path, change):
    """Change the group of each image in hloc's features."""
    with h5py.File(path / "features.h5", "r+") as file:
        found = []
        file.visititems(lambda name, _: found.append(name) if f"{name}/keypoints" in file else None)
        for name in found:
            change(file[name])


def replace_dataset(group, name, values):
    del group[name]
    group[name] = values


def pad(group, length):
    replace_dataset(group, "descriptors", np.resize(group["descriptors"][()], (length, group["scores"].size)))


def cut(group):
    for part in ("keypoints", "scores", "descriptors"):
        values = group[part][()]
        replace_dataset(group, part, values[:, :-1] if part == "descriptors" else values[:-1])


WRONG_FEATURES = {
    "shorter descriptors": (lambda g: pad(g, 64), r"have 64 values.*unlike those of 'sift'.*none has such"),
    "longer descriptors": (lambda g: pad(g, 256), r"have 256 values, none of them negative, unlike .*'sift'"),
    "signed descriptors": (
        lambda g: replace_dataset(g, "descriptors", g["descriptors"][()] - np.float16(0.05)),
        r"have 128 values, some of them negative.*extractor=NAME.*aliked, disk",
    ),
    "no descriptors": (lambda g: g.__delitem__("descriptors"), "keypoints without descriptors"),
    "descriptors of zeros": (
        lambda g: replace_dataset(g, "descriptors", 0 * g["descriptors"][()]),
        "all descriptors are zero",
    ),
    "a keypoint less": (
        cut,
        r"all 8 images of the model: image 'take 1/frame 0\.png' has \d+ keypoints in the",
    ),
}


@pytest.mark.parametrize(("change", "message"), WRONG_FEATURES.values(), ids=WRONG_FEATURES.keys())
def test_features_that_cannot_be_the_models_are_an_error(editable, change, message):
    each_group(editable.folder, change)
    with pytest.raises(InputError, match=message) as error:
        import_colmap(editable.model, options=all_features(editable.folder))
    assert str(error.value).startswith(str(editable.folder / "features.h5"))


def test_descriptors_of_two_lengths_are_an_error(editable):
    with h5py.File(editable.folder / "features.h5", "r+") as file:
        pad(file["take 1/frame 2.png"], 64)
    with pytest.raises(InputError, match=r"frame 2.* of 64 values .* other images have 128"):
        import_colmap(editable.model, options=all_features(editable.folder))


@pytest.mark.parametrize(
    ("extractor", "message"),
    [
        ("nobody", r"'nobody' is unknown; known are aliked, .*sift"),
        ("loftr", "finds no keypoints"),
        ("", "unknown"),
    ],
)
def test_an_extractor_that_cannot_be_is_an_error(project, extractor, message):
    options = replace(all_features(project.folder), extractor=extractor)
    with pytest.raises(InputError, match=message):
        import_colmap(project.model, options=options)
    with pytest.raises(ValueError, match="needs features"):
        ImportOptions(extractor="aliked")


def rename_pairs(path, change):
    with h5py.File(path / "matches.h5", "r+") as file:
        for one in list(file):
            for other in list(file[one]):
                file.move(f"{one}/{other}", change(one, other))
            del file[one]


def test_old_names_of_pairs_give_the_same_matches(editable, project):
    rename_pairs(editable.folder, lambda one, other: f"{one}_{other}")
    found, expected = (
        import_colmap(one.model, options=all_features(one.folder)) for one in (editable, project)
    )
    assert found.fingerprint == expected.fingerprint
    for pair, pairs in expected.matches.items():
        assert np.array_equal(found.matches[pair], pairs)


def features_as_matches(path):
    shutil.copy(path / "features.h5", path / "matches.h5")


def matches_as_features(path):
    shutil.copy(path / "matches.h5", path / "features.h5")


def other_images(path):
    rename_pairs(path, lambda one, other: f"x-{one}/x-{other}")


def another_run(path):
    """Matches of random keypoints."""
    rng = np.random.default_rng(0)
    with h5py.File(path / "matches.h5", "r+") as file:
        for one in file.values():
            for group in one.values():
                targets = np.full(len(group["matches0"]), -1)
                targets[:60] = rng.permutation(60)
                group["matches0"][...] = targets


WRONG_FILES = {
    "features as matches": (features_as_matches, r"matches\.h5: holds no matches"),
    "matches as features": (matches_as_features, r"features\.h5: holds no features"),
    "matches of other images": (
        other_images,
        r"matches\.h5: none of its \d+ pairs is of two images of the model",
    ),
    "matches of another run": (
        another_run,
        r"matches\.h5: none of its \d+ pairs fits the poses of the model",
    ),
}


@pytest.mark.parametrize(("change", "message"), WRONG_FILES.values(), ids=WRONG_FILES.keys())
def test_files_that_would_give_no_match_are_an_error(editable, change, message):
    change(editable.folder)
    with pytest.raises(InputError, match=message):
        import_colmap(editable.model, options=all_features(editable.folder))


def test_pairs_that_were_left_out_are_counted(editable):
    with h5py.File(editable.folder / "matches.h5", "r+") as file:
        file["other.png/take 1-frame 0.png/matches0"] = np.array([0])
        (group,) = list(file["take 1-frame 0.png"].values())[:1]
        group["matches0"][...] = -1
    notes = import_colmap(editable.model, options=all_features(editable.folder)).info.notes
    assert any("matches.h5: 1 pairs are not of two images of the model" in note for note in notes)
    assert any("pairs were left out, with fewer than 15 matches" in note for note in notes)


def test_a_database_without_matches_is_noted(editable):
    with closing(sqlite3.connect(editable.folder / "database.db")) as database:
        database.execute("DELETE FROM two_view_geometries")
        database.commit()
    map_ = import_colmap(editable.model)
    assert map_.matches == {}
    assert map_.info.notes == ("database.db: holds no verified matches of these images, so the map has none",)


def rewrite(project, change):
    model = pycolmap.Reconstruction(project.model)
    change(model)
    model.write_binary(project.model)


@pytest.mark.parametrize("observing", [False, True])
def test_keypoints_without_a_position_match_nothing_and_are_counted(editable, observing):
    def change(model):
        for image in list(model.images.values())[:2]:
            for point in list(image.points2D)[::5]:
                if observing or not point.has_point3D():
                    point.xy = np.array([np.nan, 4.0])

    rewrite(editable, change)
    original = pycolmap.Reconstruction(editable.model)
    map_ = import_colmap(editable.model)
    (note,) = map_.info.notes
    assert "keypoints of 2 images" in note
    assert ("and 0 observations were dropped" in note) == (not observing)
    count = 0
    for name, image in map_.images.items():
        xy = np.array([point.xy for point in image.points2D])
        old = np.array([point.xy for point in original.image(image.image_id).points2D])
        lost = ~np.isfinite(old).all(axis=1)
        assert np.isfinite(xy).all()
        assert np.isfinite(map_.features[name].keypoints).all()
        assert not map_.features[name].descriptors[lost].any()
        assert not lost[map_.observations[name].rows].any()
        assert not any(
            lost[pairs[:, i]].any() for pair, pairs in map_.matches.items() for i in (0, 1) if pair[i] == name
        )
        count += lost.sum()
    assert note.startswith(f"{count} keypoints")


def test_a_model_whose_points_no_image_observes_is_a_model_error(editable):
    def change(model):
        for image in model.images.values():
            for point in image.points2D:
                point.xy = np.full(2, np.nan)

    rewrite(editable, change)
    with pytest.raises(ModelError, match="no 3D points"):
        import_colmap(editable.model)


@pytest.mark.parametrize(
    "names", [("a/x.png", "a//x.png"), ("/x.png", "x.png"), ("./x.png", "/x.png"), (".", "y")]
)
def test_names_that_cannot_be_stored_apart_are_named(editable, names):
    def change(model):
        for image_id, name in enumerate(names, start=1):
            model.image(image_id).name = name

    rewrite(editable, change)
    with pytest.raises(ModelError, match="cannot be stored") as error:
        import_colmap(editable.model)
    assert repr(names[0]) in str(error.value)
