"""Maps get meters, a place and a direction up; what the data do not say is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from test_transform import positions, similarity

from commands import slimsfm
from scenes import exact_map, like_sift
from slimsfm.errors import InputError
from slimsfm.files import read_json
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.georeference import Georeference, wgs84_of_enu
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.upkeep.align import Distance, Gps, GravityUp, OtherMap, Positions, align
from slimsfm.upkeep.positions import KnownPositions, read_positions
from slimsfm.upkeep.transform import transformed
from slimsfm.upkeep.up import Down

ORIGIN = np.array([55.7058, 13.1932, 50.0])


@pytest.fixture(scope="module")
def many() -> Map:
    return like_sift(exact_map(num_images=12))


@pytest.fixture(scope="module")
def unaligned(many) -> Map:
    """The same map in a frame and a unit of its own."""
    moved = transformed(many, similarity(0, 0.37))
    return replace(moved, info=replace(moved.info, unit="unknown"))


def known(map_: Map, values: np.ndarray, **options) -> Positions:
    return Positions(known=KnownPositions(by_name=dict(zip(map_.images, values, strict=True)), **options))


def gps_photo(path: Path, place: np.ndarray | None, **changed) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "a camera"
    if place is not None:
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        for tag, reference, value, names in ((2, 1, place[0], "NS"), (4, 3, place[1], "EW")):
            minutes = abs(value) % 1 * 60
            seconds = IFDRational(round(minutes % 1 * 60 * 10**6), 10**6)
            gps[tag] = (IFDRational(int(abs(value)), 1), IFDRational(int(minutes), 1), seconds)
            gps[reference] = names[int(value < 0)]
        gps[5], gps[6] = bytes([int(place[2] < 0)]), IFDRational(round(abs(place[2]) * 1000), 1000)
        gps.update(changed.get("gps", {}))
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def test_positions_restore_the_frame(many, unaligned):
    found = align(unaligned, known(many, positions(many)))
    np.testing.assert_allclose(positions(found.map), positions(many), atol=1e-9)
    assert found.map.info.unit == "metre"
    assert found.map.info.georeference is None
    assert found.map.info.origin.endswith("; aligned by 12 known positions")
    assert found.outliers == ()


def test_slim_maps_are_aligned_as_full_ones(many, unaligned):
    slim = direct_map(unaligned, describe_points(unaligned))
    found = align(slim, known(many, positions(many)))
    np.testing.assert_allclose(positions(found.map), positions(many), atol=1e-9)


def test_a_wrong_position_is_named(many, unaligned):
    wrong = positions(many)
    wrong[3] += 2
    found = align(unaligned, known(many, wrong))
    assert found.outliers == (list(many.images)[3],)
    np.testing.assert_allclose(positions(found.map), positions(many), atol=1e-9)


def test_gps_gives_east_north_up_around_the_box(many, unaligned, tmp_path):
    true = 20 * positions(many)
    for name, place in zip(many.images, wgs84_of_enu(true, ORIGIN), strict=True):
        gps_photo(tmp_path / name, place)
    found = align(unaligned, Gps(images=tmp_path))
    place = found.map.info.georeference
    assert place is not None
    there = place.wgs84_of(positions(found.map))
    np.testing.assert_allclose(there, wgs84_of_enu(true, ORIGIN), atol=1e-2)
    np.testing.assert_allclose(there[:, :2], wgs84_of_enu(true, ORIGIN)[:, :2], atol=1e-7)
    np.testing.assert_allclose(positions(found.map), true, atol=0.02)  # the box is at the origin
    np.testing.assert_allclose(found.map.box.center, 0, atol=1e-6)


def test_noisy_gps_gives_the_heading():
    big = exact_map(num_images=40)
    true = 6 * positions(big)  # a ring of 30 m
    noisy = true + np.random.default_rng(1).normal(size=true.shape) * 3
    start = transformed(big, similarity(3))
    places = wgs84_of_enu(noisy, ORIGIN)
    found = align(start, known(big, places, is_geographic=True))
    turn = found.map.images["001.png"].cam_from_world().rotation.inverse()
    turn = turn * big.images["001.png"].cam_from_world().rotation
    *_, z, w = turn.quat
    assert abs(np.degrees(2 * np.arctan2(z, w))) < 2
    assert found.heading_bound_deg is not None
    assert found.heading_bound_deg < 5


def test_photos_without_usable_gps_are_counted(many, tmp_path):
    names = list(many.images)
    for name in names:
        gps_photo(tmp_path / name, None)
    gps_photo(tmp_path / names[0], np.array([0.0, 0.0, 10.0]))
    gps_photo(tmp_path / names[1], ORIGIN, gps={1: "?"})
    (tmp_path / names[2]).unlink()
    (tmp_path / names[3]).write_bytes(b"no photo")
    with pytest.raises(InputError, match="none of the map's 12 photos has a GPS position") as failure:
        align(many, Gps(images=tmp_path))
    for part in (
        "8 without GPS",
        "1 with GPS at 0° N 0° E",
        "1 with an impossible",
        "1 missing",
        "1 unreadable",
    ):
        assert part in str(failure.value)


@pytest.mark.parametrize(
    ("factors", "named"),
    [((2, 1, 1), "east-west, they are 2.00"), ((1, 0.5, 1), "north-south, they are 0.50")],
)
def test_gps_that_is_stretched_is_refused(many, unaligned, factors, named):
    stretched = 20 * positions(many) * factors
    with pytest.raises(InputError, match=f"contradict the images: along {named} times"):
        align(unaligned, known(many, wgs84_of_enu(stretched, ORIGIN), is_geographic=True))


def test_swapped_coordinates_are_refused(many, unaligned):
    swapped = 20 * positions(many)[:, [1, 0, 2]]
    with pytest.raises(InputError, match=r"mirror image|upside down"):
        align(unaligned, known(many, wgs84_of_enu(swapped, ORIGIN), is_geographic=True))


def test_a_distance_gives_meters_and_keeps_the_place(many):
    place = Georeference(latitude=55.7, longitude=13.2, height=40.0)
    there = replace(many, info=replace(many.info, georeference=place, unit="unknown"))
    a, b = list(many.images)[:2]
    length = float(np.linalg.norm(np.diff(positions(many)[:2], axis=0)))
    found = align(there, Distance(between=(a, b), meters=3 * length))
    np.testing.assert_allclose(positions(found.map), 3 * positions(many), atol=1e-9)
    assert found.map.info.unit == "metre"
    assert found.map.info.georeference is place
    first, last = (str(i) for i in many.point3D_ids[[0, -1]])
    assert align(there, Distance(between=(first, last), meters=1.0)).map.info.unit == "metre"


@pytest.mark.parametrize(
    ("ends", "message"),
    [(("001.png", "nothing.png"), "neither an image"), (("001.png", "001.png"), "two different")],
)
def test_a_distance_of_nothing_is_refused(many, ends, message):
    with pytest.raises(InputError, match=message):
        align(many, Distance(between=ends, meters=1.0))


def test_up_is_found_from_the_cameras(unaligned):
    found = align(unaligned, GravityUp())
    turn = found.new_from_old * similarity(0, 0.37)
    np.testing.assert_allclose(turn.rotation * np.array([0.0, 0, 1]), [0, 0, 1], atol=1e-6)
    assert found.map.info.unit == "unknown"


def test_up_is_taken_from_measured_gravity(many, unaligned):
    down = {
        name: image.cam_from_world().rotation * np.array([0.0, 0, -1]) for name, image in many.images.items()
    }
    for given in (Down(in_cam=down), Down(in_world=similarity(0, 0.37).rotation * np.array([0.0, 0, -1]))):
        turn = align(unaligned, GravityUp(down=given)).new_from_old * similarity(0, 0.37)
        np.testing.assert_allclose(turn.rotation * np.array([0.0, 0, 1]), [0, 0, 1], atol=1e-6)


def test_cameras_that_look_in_one_direction_do_not_determine_up(many):
    alike = keep_images(many, list(many.images)[:1])
    with pytest.raises(InputError, match="do not determine what is up"):
        align(alike, GravityUp())


def test_shared_images_give_the_frame_of_another_map(many, unaligned):
    other = direct_map(many, describe_points(many))
    found = align(unaligned, OtherMap(map=other))
    np.testing.assert_allclose(positions(found.map), positions(many), atol=1e-9)
    assert found.by == "12 shared images of another map"
    assert found.map.info.unit == "metre"


def test_images_are_localized_in_a_map_without_shared_ones(many, unaligned):
    names = list(many.images)
    target, source = keep_images(many, names[::2]), keep_images(unaligned, names[1::2])
    found = align(source, OtherMap(map=target))
    np.testing.assert_allclose(positions(found.map), positions(many)[1::2], atol=1e-3)
    slim = direct_map(unaligned, describe_points(unaligned))
    renamed = keep_images(many, names[::2])
    assert "localized images" in found.by
    assert align(slim, OtherMap(map=renamed)).by == "6 shared images of another map"


def test_maps_that_cannot_be_compared_are_refused(many):
    names = list(many.images)
    one, other = keep_images(many, names[::2]), keep_images(many, names[1::2])
    learned = replace(other, info=replace(other.info, extractor="aliked"))
    with pytest.raises(InputError, match="extractors aliked and sift and share no images"):
        align(learned, OtherMap(map=one))
    slim = [direct_map(map_, describe_points(map_)) for map_ in (one, other)]
    with pytest.raises(InputError, match="neither holds features"):
        align(slim[1], OtherMap(map=slim[0]))


def test_shared_images_that_contradict_each_other_are_refused(many):
    slim = direct_map(many, describe_points(many))
    model = pycolmap.Reconstruction(slim.model)
    poses = [model.image(image.image_id).cam_from_world() for image in many.images.values()]
    for index, image in enumerate(many.images.values()):
        model.frame(image.frame_id).rig_from_world = poses[(5 * index + 3) % len(poses)]
    with pytest.raises(InputError, match="contradict each other"):
        align(replace(slim, model=model), OtherMap(map=slim))


def test_tables_of_positions_are_checked(tmp_path):
    path = tmp_path / "positions.csv"
    for text, message in (
        ("name,a,b\n", "must have the columns"),
        ("name,x,y,z\n", "holds no position"),
        ("name,x,y,z\na.jpg,1,2\n", "line 2: x, y, z must be numbers"),
        ("name,x,y,z\na.jpg,1,2,nan\n", "line 2.*impossible"),
        ("name,x,y,z\na.jpg,1,2,3\na.jpg,1,2,3\n", "line 3.*twice"),
        ("name,latitude,longitude,height\na.jpg,100,2,3\n", "impossible"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_positions(path)


@pytest.fixture
def stored(unaligned, many, tmp_path) -> Path:
    write_map(unaligned, tmp_path / "map")
    for name, rows in (("good", positions(many)), ("line", positions(many) * [1, 0, 0])):
        lines = [f"{image},{x},{y},{z}" for image, (x, y, z) in zip(many.images, rows, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["name,x,y,z", *lines]) + "\n")
    (tmp_path / "others.csv").write_text("name,x,y,z\nother.jpg,1,2,3\n")
    return tmp_path


def test_the_command_says_what_it_found(stored, many):
    done = slimsfm("align", stored / "map", "-o", stored / "new", "--positions", stored / "good.csv")
    assert done.code == 0, done.err
    assert "aligned by 12 known positions, 12 of 12 agree" in done.out
    assert "scale: " in done.out
    np.testing.assert_allclose(positions(read_map(stored / "new")), positions(many), atol=1e-9)
    again = slimsfm(
        *("align", stored / "map", "-o", stored / "json", "--positions", stored / "good.csv", "--json")
    )
    assert '"inliers": 12' in again.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give one of"),
        (["--up", "--gps"], "give one of"),
        (["--gps"], "needs --images"),
        (["--distance", "2"], "needs --between A B"),
        (["--distance", "-1"], "must be positive"),
        (["--positions", "others.csv"], "none of the 1 names"),
        (["--positions", "missing.csv"], "missing.csv"),
        (["--positions", "line.csv"], "contradict|line"),
        (["--gravity", "others.csv"], "others.csv"),
        (["--to", "nothing"], "not a map"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(stored, monkeypatch, options, message):
    monkeypatch.chdir(stored)
    before = sorted(stored.iterdir())
    done = slimsfm("align", "map", "-o", "new", *options)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1
    assert any(part in done.err for part in message.split("|")), done.err
    assert sorted(stored.iterdir()) == before


def test_info_and_poses_know_the_place(many, tmp_path):
    places = wgs84_of_enu(20 * positions(many), ORIGIN)
    there = align(many, known(many, places, is_geographic=True)).map
    write_map(there, tmp_path / "map")
    assert "N, 13.193" in slimsfm("info", tmp_path / "map").out
    assert '"latitude": 55.70' in slimsfm("info", tmp_path / "map", "--json").out
    assert read_json(tmp_path / "map" / "map.json")["unit"] == "metre"
