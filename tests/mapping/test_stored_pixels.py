"""A map says which pixels of its photos it is of, and COLMAP gets a model of the stored ones."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import unwrap
from itertools import cycle
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from commands import slimsfm
from exif_photos import MIRRORED, STORED, save_photo
from slimsfm.cli.output import quiet
from slimsfm.errors import ImageError, InputError, MapError
from slimsfm.geometry import rotation_error_deg
from slimsfm.localization import Localizer, MultiLocalizer, localize_images, localize_objects
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.mapping.orientation import stored_model, turned_pose
from slimsfm.photos import read_image, read_photo
from slimsfm.synthetic.scene import mapping_take

ROTATED = (1, 3, 6, 8)


@dataclass(frozen=True)
class Photos:
    folder: Path
    tags: dict[str, int]


def save_all(folder: Path, upright: list[np.ndarray], tags: tuple[int, ...]) -> Photos:
    saved = {f"{i}.png": tag for i, (_, tag) in enumerate(zip(upright, cycle(tags), strict=False))}
    for (name, tag), picture in zip(saved.items(), upright, strict=True):
        save_photo(folder / name, picture, tag)
    return Photos(folder, saved)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    take = mapping_take("printed_box", 80, 320, 240, 0)
    return [take.frame(i) for i in range(8)]


@pytest.fixture(scope="module")
def plain(pictures, tmp_path_factory) -> tuple[Photos, Map]:
    photos = save_all(tmp_path_factory.mktemp("plain"), pictures, (1,))
    return photos, build_map(photos.folder)


@pytest.fixture(scope="module")
def upright(pictures, tmp_path_factory) -> tuple[Photos, Map]:
    """The map of the same pictures, stored with every EXIF orientation."""
    photos = save_all(tmp_path_factory.mktemp("upright"), pictures, (*ROTATED, *MIRRORED))
    return photos, build_map(photos.folder)


@pytest.fixture(scope="module", params=[ROTATED, MIRRORED], ids=["rotated", "mirrored"])
def stored(request, pictures, tmp_path_factory) -> tuple[Photos, Map]:
    """A map of the stored pixels, as COLMAP makes it. All pictures of one scene are mirrored, or none is."""
    photos = save_all(tmp_path_factory.mktemp("stored"), pictures, request.param)
    return photos, build_map(photos.folder, BuildOptions(orientation="stored"))


@pytest.fixture(scope="module")
def query(tmp_path_factory) -> Path:
    """A photo of the same object, stored with each of the EXIF orientations that are rotations."""
    folder, picture = (
        tmp_path_factory.mktemp("queries"),
        mapping_take("printed_box", 90, 320, 240, 0).frame(3),
    )
    for tag in ROTATED:
        save_photo(folder / f"{tag}.png", picture, tag)
    return folder


def undistorted(
    model: pycolmap.Reconstruction, photos: Photos, folder: Path
) -> Iterator[tuple[str, np.ndarray]]:
    """The pictures that COLMAP makes of a model and the photos."""
    (folder / "model").mkdir()
    model.write(folder / "model")
    with quiet():
        pycolmap.undistort_images(folder / "out", folder / "model", photos.folder)
    for path in sorted((folder / "out" / "images").iterdir()):
        yield path.name, read_image(path, "stored")  # COLMAP copies the EXIF data


def test_an_upright_map_does_not_depend_on_how_the_pixels_are_stored(plain, upright):
    assert upright[1].fingerprint == plain[1].fingerprint
    assert upright[1].info.orientation == "upright"
    tags = {name: tag for name, tag in upright[0].tags.items() if tag != 1}
    assert upright[1].info.exif_orientations == tags
    assert plain[1].info.exif_orientations == {}


def test_colmap_undistorts_the_photos_of_an_upright_map(plain, upright, tmp_path):
    for name in ("plain", "turned"):
        (tmp_path / name).mkdir()
    expected = dict(undistorted(stored_model(plain[1]), plain[0], tmp_path / "plain"))
    photos, map_ = upright
    found = dict(undistorted(stored_model(map_), photos, tmp_path / "turned"))
    assert list(found) == [name for name, tag in photos.tags.items() if tag not in MIRRORED]
    for name, picture in found.items():
        turned = STORED[photos.tags[name]](expected[name])
        assert picture.shape == turned.shape
        assert np.abs(picture.astype(int) - turned).mean() < 2  # JPEG, and interpolation


def test_colmap_undistorts_the_photos_of_an_imported_model(stored, tmp_path):
    photos, built = stored
    (tmp_path / "sparse").mkdir()
    built.model.write(tmp_path / "sparse")
    imported = import_colmap(tmp_path / "sparse", photos.folder)
    assert imported.info.orientation == "stored"
    assert stored_model(imported) is imported.model
    found = dict(undistorted(imported.model, photos, tmp_path))
    assert list(found) == sorted(photos.tags)
    for name, picture in found.items():
        original = read_image(photos.folder / name, "stored")
        assert abs(picture.shape[0] / picture.shape[1] / original.shape[0] * original.shape[1] - 1) < 0.05


def test_pictures_held_upright_and_sideways_share_a_camera(stored, plain):
    photos, map_ = stored
    assert sorted(map_.images) == sorted(photos.tags)
    wide, tall = sorted(map_.model.cameras.values(), key=lambda camera: camera.height)
    assert (wide.width, wide.height, tall.width, tall.height) == (320, 240, 240, 320)
    assert [wide.focal_length, wide.params[3]] == [tall.focal_length, tall.params[3]]
    assert wide.focal_length == pytest.approx(plain[1].shared_camera.focal_length, rel=0.02)
    for name, image in map_.images.items():
        assert (map_.camera(name).width, map_.camera(name).height) == map_.features[name].image_size
        keypoints = np.array([point.xy for point in image.points2D], np.float32)
        assert np.array_equal(keypoints, map_.features[name].keypoints)
    errors_px = [one.model.compute_mean_reprojection_error() for one in (map_, plain[1])]
    assert errors_px[0] < 1.2 * errors_px[1]


def test_a_query_is_read_as_its_map_says(plain, stored, query):
    if stored[0].tags["0.png"] in MIRRORED:
        pytest.skip("no photo shows a mirrored scene")
    camera = plain[1].shared_camera
    upright = localize_images(Localizer(plain[1]), query, camera=camera)
    poses = [one.pose.cam_from_world.matrix() for one in upright.values() if one.pose]
    assert len(poses) == 4
    assert all(np.array_equal(pose, poses[0]) for pose in poses)
    localizer = Localizer(stored[1])
    for tag, turns in zip(ROTATED, (0, 2, 3, 1), strict=True):
        own = next(one for one in stored[1].model.cameras.values() if (one.width > one.height) == (tag < 5))
        found = localize_images(localizer, query / f"{tag}.png", camera=own)[f"{tag}.png"]
        first = localizer.localize(read_image(query / "1.png"), stored[1].camera("0.png"))
        assert found.orientation == "stored"
        assert found.pose is not None
        assert first.pose is not None
        expected = turned_pose(first.pose.cam_from_world, turns)
        assert rotation_error_deg(found.pose.cam_from_world, expected) < 0.6  # from an image of 128 pixels


def test_one_query_is_read_both_ways_for_maps_of_both_kinds(plain, stored, query):
    localizers = {"upright": Localizer(plain[1]), "stored": Localizer(stored[1])}
    both = localize_objects(MultiLocalizer(localizers), query / "3.png", camera=plain[1].shared_camera)
    for key, localizer in localizers.items():
        alone = localize_images(localizer, query / "3.png", camera=plain[1].shared_camera)["3.png"]
        together = both[key]["3.png"]
        assert together.orientation == key == localizer.map.info.orientation
        assert (together.pose is None) == (alone.pose is None)
        if alone.pose and together.pose:
            assert np.array_equal(alone.pose.cam_from_world.matrix(), together.pose.cam_from_world.matrix())


def test_the_orientation_survives_writing_and_old_maps_are_upright(upright, stored, tmp_path):
    for name, map_ in (("upright", upright[1]), ("stored", stored[1])):
        write_map(map_, tmp_path / name)
        read = read_map(tmp_path / name)
        assert read.info.orientation == map_.info.orientation == name
        assert read.info.exif_orientations == map_.info.exif_orientations
    file = tmp_path / "upright" / "map.json"
    data = json.loads(file.read_text())
    for key in ("orientation", "exif_orientations", "checksums"):
        del data[key]
    file.write_text(json.dumps(data))
    assert read_map(tmp_path / "upright").info.orientation == "upright"
    file.write_text(json.dumps({**data, "orientation": "sideways"}))
    with pytest.raises(MapError, match=r"map\.json: damaged \('sideways' is not one of upright, stored"):
        read_map(tmp_path / "upright")


def test_a_model_of_upright_pictures_is_imported_as_such(upright, tmp_path):
    photos, map_ = upright
    map_.model.write(tmp_path)
    with pytest.raises(ImageError, match=r"2\.png: 240x320 pixels.*320x240.*orientation='upright'"):
        import_colmap(tmp_path, photos.folder)
    imported = import_colmap(tmp_path, options=ImportOptions(images=photos.folder, orientation="upright"))
    assert imported.info.exif_orientations == map_.info.exif_orientations
    assert stored_model(imported).num_images() == 4


def test_the_commands_say_which_pixels_a_map_is_of(upright, tmp_path):
    photos, map_ = upright
    write_map(map_, tmp_path / "map")
    assert "upright (7 of 8 images turned by EXIF)" in slimsfm("info", tmp_path / "map").out
    exported = slimsfm("export", "colmap", tmp_path / "map", "-o", tmp_path / "model")
    assert exported.code == 0
    assert re.search(r"4 images left out.*mirrors them: 4\.png, 5\.png, 6\.png, 7\.png", exported.out)
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert sorted(image.name for image in model.images.values()) == ["0.png", "1.png", "2.png", "3.png"]
    assert (
        slimsfm("import", tmp_path / "model", "--images", photos.folder, "-o", tmp_path / "again").code == 0
    )
    assert "as stored" in slimsfm("info", tmp_path / "again").out
    hloc = slimsfm("export", "hloc", tmp_path / "map", "-o", tmp_path / "hloc")
    assert hloc.code == 0
    back = ImportOptions(features=tmp_path / "hloc" / "features.h5", matches=tmp_path / "hloc" / "matches.h5")
    again = import_colmap(tmp_path / "hloc" / "sfm", options=back)
    for name, image in again.images.items():
        keypoints = np.array([point.xy for point in image.points2D], np.float32)
        assert keypoints == pytest.approx(again.features[name].keypoints, abs=1e-3)
        size = again.camera(name).width, again.camera(name).height
        assert again.features[name].image_size == size
    assert again.matches.keys() == {pair for pair in map_.matches if set(pair) <= again.images.keys()}


@pytest.mark.parametrize("tag", STORED)
@pytest.mark.parametrize("orientation", ["upright", "stored"])
def test_masks_are_of_the_pixels_that_are_read(tmp_path, tag, orientation):
    picture, mask = np.zeros((40, 60, 3), np.uint8), np.zeros((40, 60), np.uint8)
    mask[:10, :20] = 255
    expected = mask if orientation == "upright" else STORED[tag](mask)
    for name, saved, own_tag in (
        ("tagged.png", mask, tag),  # says itself how it is stored
        ("alike.png", expected, 1),  # is stored as the photo is read
        *([("other.png", STORED[tag](mask) if orientation == "upright" else mask, 1)] if tag > 4 else []),
    ):
        save_photo(tmp_path / "photos" / name, picture, tag)
        save_photo(tmp_path / "masks" / f"{name}.png", saved, own_tag)
    names = sorted(path.name for path in (tmp_path / "photos").iterdir())
    photos = MaskedPhotos(tmp_path / "photos", names, tmp_path / "masks", orientation=orientation)
    for name in names:
        found = photos.read(name).mask
        assert found is not None
        assert np.array_equal(found, expected), name


def test_another_orientation_is_refused():
    with pytest.raises(ValueError, match="orientation must be one of upright, stored, got 'sideways'"):
        unwrap(read_photo)("a.png", "sideways")


def test_without_a_detector_pictures_held_both_ways_cannot_be_told_to_share_a_camera(tmp_path, textured):
    for i in range(3):
        save_photo(tmp_path / f"{i}.png", textured.swapaxes(0, 1) if i == 1 else textured)
    options = BuildOptions(extractor="loftr", camera="shared")
    with pytest.raises(InputError, match=r"1\.png: width and height are swapped.*camera='auto'"):
        build_map(tmp_path, options)
