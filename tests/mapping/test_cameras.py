"""A map knows which devices its cameras are of, and tells cameras apart by what they are."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL.TiffImagePlugin import IFDRational

from exif_photos import save_photo
from slimsfm.devices import Device
from slimsfm.errors import MapError
from slimsfm.localization.cameras import query_camera
from slimsfm.mapping.build import build_map
from slimsfm.mapping.cameras import devices_by_camera
from slimsfm.mapping.importing import import_colmap
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.work import BuildOptions, KnownPoses
from slimsfm.reduction import ReduceOptions, reduce
from slimsfm.synthetic.scene import mapping_take

PHONE = {
    "Make": "Acme",
    "Model": "P1",
    "FocalLength": IFDRational(42, 10),
    "FocalLengthIn35mmFilm": 24,
    "DigitalZoomRatio": IFDRational(3, 2),
}
DEVICE = Device(make="Acme", model="P1", focal_mm=4.2, focal_35mm=24.0, digital_zoom=1.5)


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder, take = tmp_path_factory.mktemp("photos"), mapping_take("printed_box", 80, 320, 240, 0)
    for i in range(8):
        save_photo(folder / f"{i}.jpg", take.frame(i), **PHONE)
    return folder


@pytest.fixture(scope="module")
def built(photos: Path) -> Map:
    return build_map(photos, BuildOptions(orientation="stored"))


def test_build_and_import_store_what_exif_says(built: Map, photos: Path, tmp_path: Path) -> None:
    (camera_id,) = built.model.cameras
    assert built.info.devices == {camera_id: DEVICE}
    built.model.write(tmp_path)
    assert import_colmap(tmp_path, photos).info.devices == {camera_id: DEVICE}
    known = KnownPoses(
        cam_from_world={name: image.cam_from_world() for name, image in built.images.items()},
        cameras={name: built.camera(name) for name in built.images},
        box=built.box,
        unit="unknown",
    )
    assert set(build_map(photos, known=known).info.devices.values()) == {DEVICE}


def test_the_photos_of_a_map_have_its_camera(built: Map, photos: Path) -> None:
    for name in built.images:
        chosen = query_camera(built, photos / name, None, "known")
        assert chosen.source == "map"
        assert np.array_equal(chosen.camera.params, built.camera(name).params)


def test_devices_survive_whatever_is_made_of_a_map(exact: Map, tmp_path: Path) -> None:
    map_ = replace(exact, info=replace(exact.info, devices={1: DEVICE}))
    smaller = [keep_images(map_, list(map_.images)[:4]), reduce(map_, ReduceOptions()).map]
    for number, one in enumerate([map_, *smaller]):
        write_map(one, tmp_path / str(number))
        assert read_map(tmp_path / str(number)).info.devices == {1: DEVICE}


def test_only_a_clear_majority_of_photos_names_a_device(exact: Map) -> None:
    for count, expected in ((6, {1: DEVICE}), (5, {1: DEVICE}), (4, {}), (0, {})):
        devices = dict.fromkeys(list(exact.images)[:count], DEVICE)
        assert devices_by_camera(exact.model, devices) == expected
        others = {name: devices.get(name, replace(DEVICE, model="P2")) for name in exact.images}
        assert devices_by_camera(exact.model, others) == (
            expected if count else {1: replace(DEVICE, model="P2")}
        )


def test_equal_cameras_of_two_devices_have_none(exact: Map) -> None:
    model = pycolmap.Reconstruction()
    for image_id, (name, image) in enumerate(exact.images.items(), start=1):
        own = pycolmap.Camera(exact.camera(name).todict())
        own.camera_id = image_id
        model.add_camera_with_trivial_rig(own)
        keypoints = exact.features[name].keypoints.astype(float)
        copy = pycolmap.Image(name=name, keypoints=keypoints, camera_id=image_id, image_id=image_id)
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for devices, expected in (
        ({1: DEVICE, 2: DEVICE}, DEVICE),
        ({1: DEVICE, 2: replace(DEVICE, model="P2")}, None),
        ({}, None),
    ):
        (one,) = replace(exact, model=model, info=replace(exact.info, devices=devices)).cameras
        assert one.device == expected


def test_an_older_map_has_no_devices_and_a_damaged_one_is_refused(built: Map, tmp_path: Path) -> None:
    write_map(built, tmp_path / "map")
    file = tmp_path / "map" / "map.json"
    data = json.loads(file.read_text())
    del data["checksums"]
    file.write_text(json.dumps({key: value for key, value in data.items() if key != "devices"}))
    assert read_map(tmp_path / "map").info.devices == {}
    for wrong in ([1], {"x": {}}, {"1": {"make": 5}}, {"1": 5}):
        file.write_text(json.dumps({**data, "devices": wrong}))
        with pytest.raises(MapError, match=r"map\.json: damaged"):
            read_map(tmp_path / "map")
