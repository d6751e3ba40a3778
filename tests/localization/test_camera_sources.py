"""Where the camera of a query comes from: given, the map's, EXIF, or nowhere; in this order, and said."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from exif_photos import save_photo
from scenes import camera
from slimsfm.devices import Device
from slimsfm.localization.cameras import camera_in_memory, guess_camera, query_camera
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.orientation import turned_camera

LENS = {"Make": "Acme", "Model": "P1", "FocalLength": IFDRational(42, 10)}
PHONE = {**LENS, "FocalLengthIn35mmFilm": 22}  # 407 px for the 502 px of the calibrated camera, as of a drone
DEVICE = Device(make="Acme", model="P1", focal_mm=4.2, focal_35mm=22.0)
DIAGONAL_MM = np.hypot(36, 24)


def focal_of(focal_35mm: float, size: tuple[int, int] = (640, 480)) -> float:
    return focal_35mm / DIAGONAL_MM * np.hypot(*size)


def save(path: Path, size: tuple[int, int] = (640, 480), orientation: int = 1, **tags: Any) -> Path:
    return save_photo(path, np.zeros((size[1], size[0], 3), np.uint8), orientation, **tags)


def with_cameras(
    map_: Map, cameras: list[pycolmap.Camera], devices: dict[int, Device] | None = None
) -> Map:
    """The map with one camera per image, in turn, with the ids 1, 2, ..."""
    model = pycolmap.Reconstruction()
    for image_id, image in enumerate(map_.images.values(), start=1):
        own = pycolmap.Camera(cameras[(image_id - 1) % len(cameras)].todict())
        own.camera_id = image_id
        model.add_camera_with_trivial_rig(own)
        keypoints = map_.features[image.name].keypoints.astype(float)
        copy = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image_id, image_id=image_id)
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point3D_id, point in map_.model.points3D.items():
        model.add_point3D_with_id(point3D_id, point)
    return replace(map_, model=model, info=replace(map_.info, devices=devices or {}))


def other(focal_px: float, size: tuple[int, int] = (640, 480)) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, "PINHOLE", focal_px, *size)


@pytest.fixture(scope="module")
def known(exact: Map) -> Map:
    """A map whose one camera has a device."""
    return replace(exact, info=replace(exact.info, devices={1: DEVICE}))


class Case(NamedTuple):
    says: str
    query: Callable[[Path], Path]
    source: str
    focal_px: float
    by_old_map: str | None = None  # the source if the map has no device, where that differs


FOCAL = camera().mean_focal_length()
GUESS = 1.2 * 640


def of(size: tuple[int, int] = (640, 480), orientation: int = 1, **tags: Any) -> Callable[[Path], Path]:
    return lambda folder: save(folder / "a.jpg", size, orientation, **tags)


CASES = [
    Case("the same device", of(**PHONE), "map", FOCAL, "exif"),
    Case("the same device, resized", of((320, 240), **PHONE), "map", FOCAL / 2, "exif"),
    Case("the same device, held sideways", of((480, 640), 6, **PHONE), "map", FOCAL, "exif"),
    Case("the same device, turned by an editor", of((480, 640), **PHONE), "map", FOCAL, "exif"),
    Case("no EXIF data: a frame of the same film", of(), "map", FOCAL),
    Case("no EXIF data, resized", of((960, 720)), "map", 1.5 * FOCAL),
    Case("no device, but held sideways", of((480, 640), 6), "map", FOCAL),
    Case("a device whose focal lengths were removed", of(Make="Acme", Model="P1"), "map", FOCAL),
    Case("the same lens by f alone", of(**LENS), "map", FOCAL),
    Case("the map's focal length in EXIF, no device", of(FocalLengthIn35mmFilm=22), "map", FOCAL, "exif"),
    Case("impossible focal length", of(**{**PHONE, "FocalLengthIn35mmFilm": 65535}), "map", FOCAL),
    Case("impossible zoom", of(**PHONE, DigitalZoomRatio=IFDRational(1000, 1)), "map", FOCAL, "exif"),
    Case("a zoom that is no number", of(**PHONE, DigitalZoomRatio=IFDRational(0, 0)), "map", FOCAL, "exif"),
    Case("a zoom of 0, which is none", of(**PHONE, DigitalZoomRatio=IFDRational(0, 1)), "map", FOCAL, "exif"),
    Case("digital zoom", of(**PHONE, DigitalZoomRatio=IFDRational(2, 1)), "exif", 2 * FOCAL, "unknown"),
    Case(
        "digital zoom that f35 includes",
        of(**LENS, FocalLengthIn35mmFilm=33, DigitalZoomRatio=IFDRational(3, 2)),
        "exif",
        1.5 * FOCAL,
        "unknown",
    ),
    Case("another make", of(**{**PHONE, "Make": "Other"}), "exif", focal_of(22)),
    Case("another model", of(**{**PHONE, "Model": "P2"}), "exif", focal_of(22)),
    Case("another lens", of(**{**PHONE, "FocalLength": IFDRational(9, 1)}), "exif", focal_of(22)),
    Case("another focal length, no device", of(FocalLengthIn35mmFilm=80), "exif", focal_of(80)),
    Case("another shape", of((640, 400), **PHONE), "exif", focal_of(22, (640, 400))),
    Case("another device without focal length", of(Make="Other"), "unknown", GUESS, "map"),
    Case("another shape without EXIF data", of((640, 400)), "unknown", GUESS),
    Case("turned without EXIF data", of((480, 640)), "unknown", GUESS),
    Case(
        "another device with an impossible focal length",
        of(Make="Other", FocalLengthIn35mmFilm=65535),
        "unknown",
        GUESS,
        "map",
    ),
    Case(
        "one side cut: the focal length stays",
        of((640, 400), **PHONE, ExifImageWidth=640, ExifImageHeight=480),
        "exif",
        focal_of(22),
    ),
    Case(
        "much cut out: no focal length",
        of((640, 480), **PHONE, ExifImageWidth=1920, ExifImageHeight=1080),
        "unknown",
        GUESS,
    ),
    Case(
        "resized: same shape as it was",
        of(**PHONE, ExifImageWidth=4000, ExifImageHeight=3000),
        "map",
        FOCAL,
        "exif",
    ),
]


@pytest.mark.parametrize("case", CASES, ids=[case.says for case in CASES])
@pytest.mark.parametrize("has_device", [True, False], ids=["device", "old map"])
def test_the_order(case: Case, has_device: bool, exact: Map, known: Map, tmp_path: Path) -> None:
    """Given; the map's where size and EXIF fit; EXIF, corrected for zoom; unknown."""
    map_, path = (known if has_device else exact), case.query(tmp_path)
    chosen = query_camera(map_, path, None)
    expected = case.source if has_device else (case.by_old_map or case.source)
    assert chosen.source == expected
    if has_device or case.by_old_map is None:
        assert chosen.camera.mean_focal_length() == pytest.approx(case.focal_px, rel=1e-3)
    with Image.open(path) as file:
        size = file.size
    turned = size[::-1] if "held sideways" in case.says else size
    assert (chosen.camera.width, chosen.camera.height) == turned
    for focal in ("approximate", "unknown"):
        assert query_camera(map_, path, None, focal).source == expected
    if turned == (640, 480):
        assert query_camera(map_, path, other(900)).source == "given"
        assert query_camera(map_, path, other(900)).camera.mean_focal_length() == 900
