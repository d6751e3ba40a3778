"""Where the camera of a query comes from: given, the map's, EXIF, or nowhere; in this order, and said."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import IFDRational

from exif_photos import save_photo
from scenes import camera
from slimsfm.devices import Device
from slimsfm.localization.cameras import UnknownIntrinsicsError, camera_in_memory, guess_camera, query_camera
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


def with_cameras(map_: Map, cameras: list[pycolmap.Camera], devices: dict[int, Device] | None = None) -> Map:
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


def test_a_picture_held_sideways_has_the_turned_camera(known: Map, tmp_path: Path) -> None:
    for orientation, turns in ((6, 1), (8, 3)):
        path = save(tmp_path / "a.jpg", (480, 640), orientation, **PHONE)
        chosen = query_camera(known, path, None).camera
        assert np.allclose(chosen.params, turned_camera(camera(), turns).params)


def test_a_digital_zoom_enlarges_the_center(known: Map, tmp_path: Path) -> None:
    """What the map's camera sees at (x, y) from the center, the zoomed one sees at twice that."""
    rays = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 2))
    rays = np.column_stack([rays, np.ones(50)])
    zoomed = query_camera(known, save(tmp_path / "a.jpg", **PHONE, DigitalZoomRatio=IFDRational(2, 1)), None)
    center = np.array([320, 240])
    expected = center + 2 * (camera().img_from_cam(rays) - center)
    assert np.allclose(zoomed.camera.img_from_cam(rays), expected)


def test_a_digital_zoom_counts_where_the_focal_length_cannot_include_it(exact: Map, tmp_path: Path) -> None:
    lens = {"Make": "Apple", "Model": "iPhone 6", "FocalLength": IFDRational(42, 10)}  # in COLMAP's list
    map_ = with_cameras(exact, [other(2000)])
    plain = query_camera(map_, save(tmp_path / "a.jpg", **lens), None)
    zoomed = query_camera(map_, save(tmp_path / "b.jpg", **lens, DigitalZoomRatio=IFDRational(3, 1)), None)
    assert (plain.source, zoomed.source) == ("exif", "exif")
    assert zoomed.camera.focal_length == pytest.approx(3 * plain.camera.focal_length)


@pytest.mark.parametrize("written", ['crs:HasCrop="True"', "<crs:HasCrop>True</crs:HasCrop>"])
@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_a_crop_by_an_editor_is_unknown(written: str, suffix: str, known: Map, tmp_path: Path) -> None:
    path = save(tmp_path / f"a.{suffix}", **PHONE)
    with Image.open(path) as file:
        exif, options = file.getexif(), {}
        exif.get_ifd(ExifTags.IFD.Exif)  # or it would not be saved
        if suffix == "tif":
            exif[ExifTags.Base.XMLPacket] = written.encode()
        elif suffix != "png":
            options = {"xmp": written.encode()}
        else:
            info = PngInfo()
            info.add_itxt("XML:com.adobe.xmp", written)
            options = {"pnginfo": info}
        file.save(path, exif=exif, **options)
    chosen = query_camera(known, path, None)
    assert chosen.source == "unknown"
    (note,) = chosen.notes
    assert note.startswith(f"{path}: ")
    assert "cropped" in note
    with pytest.raises(UnknownIntrinsicsError, match=r"a\..*cropped"):
        query_camera(known, path, None, "known")


@pytest.mark.parametrize(
    ("tags", "said"),
    [
        ({"FocalLengthIn35mmFilm": 65535}, "FocalLengthIn35mmFilm 65535, which is impossible"),
        ({"FocalLengthIn35mmFilm": 0}, "FocalLengthIn35mmFilm 0, which is impossible"),
        ({"DigitalZoomRatio": IFDRational(1000, 1)}, "DigitalZoomRatio 1000"),
        ({"DigitalZoomRatio": IFDRational(1, 10)}, "DigitalZoomRatio 0.1"),
        ({"DigitalZoomRatio": IFDRational(0, 0)}, "DigitalZoomRatio nan"),
        (
            {"FocalLengthIn35mmFilm": 28, "DigitalZoomRatio": IFDRational(2, 1)},
            "includes the digital zoom (2x) is unknown",
        ),
        (
            {"FocalLengthIn35mmFilm": 28, "ExifImageWidth": 4000, "ExifImageHeight": 2000},
            "its 640x480 pixels were cut out of 4000x2000",
        ),
    ],
    ids=repr,
)
def test_what_is_ignored_is_said_with_the_photo(tags: dict, said: str, exact: Map, tmp_path: Path) -> None:
    path = save(tmp_path / "odd.jpg", **tags)
    (note,) = query_camera(exact, path, None).notes
    assert note.startswith(f"{path}: ")
    assert said in note
    assert query_camera(exact, path, camera()).notes == ()  # it does not matter then


def test_equal_cameras_are_one_whatever_their_ids(exact: Map, tmp_path: Path) -> None:
    """Exports of NeRFs have a camera for each image."""
    nerf = with_cameras(exact, [camera()])
    assert len(nerf.model.cameras) == 6
    assert len(nerf.cameras) == 1
    chosen = query_camera(nerf, save(tmp_path / "a.png"), None, "known")
    assert chosen.source == "map"
    assert np.array_equal(chosen.camera.params, camera().params)
    assert np.array_equal(nerf.shared_camera.params, camera().params)
    write_map(nerf, tmp_path / "map")
    assert len(read_map(tmp_path / "map").cameras) == 1


def test_of_several_cameras_the_one_that_fits_is_taken(exact: Map, tmp_path: Path) -> None:
    wide, long = other(400), other(800)
    upright, small = other(600, (480, 640)), other(300, (320, 240))
    of_long = Device(make="Acme", model="P1", focal_mm=8.4)
    map_ = with_cameras(exact, [wide, long, upright], {1: DEVICE, 4: DEVICE, 2: of_long, 5: of_long})

    def source_and_focal(path: Path, within: Map = map_) -> tuple[str, float]:
        chosen = query_camera(within, path, None)
        return chosen.source, round(chosen.camera.mean_focal_length())

    assert source_and_focal(save(tmp_path / "a.jpg", **PHONE)) == ("map", 400)
    assert source_and_focal(save(tmp_path / "a.jpg", **{**LENS, "FocalLength": IFDRational(84, 10)})) == (
        "map",
        800,
    )
    assert source_and_focal(save(tmp_path / "a.jpg")) == ("unknown", GUESS)  # both fit, and differ
    assert source_and_focal(save(tmp_path / "a.jpg", (480, 640))) == ("map", 600)  # one has this size
    sizes = with_cameras(exact, [wide, small])
    assert source_and_focal(save(tmp_path / "a.jpg"), sizes) == ("map", 400)
    assert source_and_focal(save(tmp_path / "a.jpg", (320, 240)), sizes) == ("map", 300)
    assert source_and_focal(save(tmp_path / "a.jpg", (1280, 960)), sizes) == ("unknown", 2 * GUESS)
    closest = save(tmp_path / "a.jpg", FocalLengthIn35mmFilm=35)
    assert source_and_focal(closest, with_cameras(exact, [wide, other(650)])) == ("map", 650)


def test_an_image_in_memory_has_the_camera_of_the_map_of_its_size(exact: Map, two_cameras: Map) -> None:
    given = camera_in_memory(exact, 640, 480, other(900))
    assert (given.source, given.camera.focal_length_x) == ("given", 900)
    of_map = camera_in_memory(exact, 320, 240)
    assert (of_map.source, of_map.camera.focal_length_x) == ("map", 250)
    for map_, size in ((exact, (480, 640)), (two_cameras, (640, 480))):
        unknown = camera_in_memory(map_, *size)
        assert unknown.source == "unknown"
        assert np.array_equal(unknown.camera.params, guess_camera(*size).params)
    with pytest.raises(ValueError, match="size 320x240, got 640x480"):
        camera_in_memory(exact, 320, 240, camera())
