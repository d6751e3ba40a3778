import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pycolmap
import pytest

from scenes import exact_map
from slimsfm.errors import MapError, OutputError
from slimsfm.geometry import Box
from slimsfm.mapping.info_file import FORMAT_VERSION
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import check_map


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def written(exact, tmp_path):
    write_map(exact, tmp_path / "map")
    return tmp_path / "map"


def assert_equal(one, two):
    assert list(one.images) == list(two.images)
    assert np.array_equal(one.point3D_ids, two.point3D_ids)
    assert np.array_equal(one.points3D_in_world, two.points3D_in_world)
    assert np.array_equal(one.colors, two.colors)
    for name, image in one.images.items():
        other = two.images[name]
        assert image.image_id == other.image_id
        assert np.array_equal(image.cam_from_world().matrix(), other.cam_from_world().matrix())
        assert repr(one.camera(name)) == repr(two.camera(name))
        assert np.array_equal(one.camera(name).params, two.camera(name).params)
        assert np.array_equal(one.observations[name].rows, two.observations[name].rows)
        assert np.array_equal(one.observations[name].points, two.observations[name].points)
        for part in ("keypoints", "descriptors", "scores"):
            assert np.array_equal(getattr(one.features[name], part), getattr(two.features[name], part))
        assert one.features[name].image_size == two.features[name].image_size
    for i in one.point3D_ids.tolist():
        tracks = [
            [(e.image_id, e.point2D_idx) for e in map_.model.point3D(i).track.elements] for map_ in (one, two)
        ]
        assert tracks[0] == tracks[1]
    assert list(one.matches) == list(two.matches)
    for pair in one.matches:
        assert np.array_equal(one.matches[pair], two.matches[pair])
    assert np.array_equal(one.box.corners, two.box.corners)
    for part in ("extractor", "extractor_options", "box_source", "unit", "origin"):
        assert getattr(one.info, part) == getattr(two.info, part)


def test_a_map_is_read_as_it_was_written(exact, written):
    assert len(exact.matches) == 5
    assert_equal(exact, read_map(written))


def test_a_built_map_is_read_as_it_was_written(unposed, tmp_path):
    write_map(unposed.map, tmp_path / "map")
    assert_equal(unposed.map, read_map(tmp_path / "map"))


def test_equal_maps_are_equal_files(exact, written, tmp_path):
    write_map(exact, tmp_path / "again")
    write_map(read_map(written), tmp_path / "copy")
    assert files(tmp_path / "again") == files(written)
    assert files(tmp_path / "copy") == files(written)


def test_a_map_may_overwrite_the_one_it_is_read_from(written):
    before = files(written)
    with pytest.raises(OutputError, match="exists already"):
        write_map(read_map(written), written)
    write_map(read_map(written), written, overwrite=True)
    assert files(written) == before


def test_a_map_without_matches_has_no_match_file(exact, tmp_path):
    write_map(replace(exact, matches={}), tmp_path / "map")
    assert not (tmp_path / "map" / "matches.h5").exists()
    assert read_map(tmp_path / "map").matches == {}


def test_the_model_opens_in_pycolmap(written, exact):
    model = pycolmap.Reconstruction(written / "sparse")
    assert model.is_valid()
    assert model.num_points3D() == len(exact.point3D_ids)
    assert model.compute_mean_reprojection_error() == pytest.approx(0, abs=1e-9)


def test_points_project_to_their_observations(exact):
    for name, seen in exact.observations.items():
        image = exact.images[name]
        points = image.cam_from_world() * exact.points3D_in_world[seen.points]
        pixels = exact.camera(name).img_from_cam(points)
        assert exact.features[name].keypoints[seen.rows] == pytest.approx(pixels, abs=1e-3)


def test_the_sizes_of_the_parts_sum_to_the_total(written):
    (written / "notes.txt").write_text("not a part")
    sizes = bytes_by_part(written)
    assert set(sizes) == {"sparse", "features.h5", "matches.h5", "map.json", "total"}
    assert sizes["total"] == sum(len(data) for data in files(written).values()) - len("not a part")


def change_info(path, change=dict.copy):
    """Change map.json and leave out its checksums, as older maps do."""
    data = json.loads((path / "map.json").read_text())
    data.pop("checksums", None)
    change(data)
    (path / "map.json").write_text(json.dumps(data))


IMPOSSIBLE_BOXES = {
    "without extent": {"half_edges": (1e-100 * np.eye(3)).tolist()},
    "much smaller than the map": {"half_edges": (1e-9 * np.eye(3)).tolist()},
    "much larger than the map": {"half_edges": (1e12 * np.eye(3)).tolist()},
    "far away": {"center": [1e200, 0, 0]},
}


@pytest.mark.parametrize("change", IMPOSSIBLE_BOXES.values(), ids=IMPOSSIBLE_BOXES.keys())
def test_a_map_with_an_impossible_box_is_neither_read_nor_written(exact, written, change, tmp_path):
    change_info(written, lambda data: data["box"].update(change))
    with pytest.raises(MapError, match=r"the map cannot be right: its .*box"):
        read_map(written)
    values = {"center": exact.box.center, "half_edges": exact.box.half_edges, **change}
    box = Box(*(np.array(values[name], np.float64) for name in ("center", "half_edges")))
    with pytest.raises(MapError, match=r"the map cannot be right: its .*box"):
        write_map(replace(exact, info=replace(exact.info, box=box)), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_a_map_of_a_later_format_asks_to_upgrade(written):
    change_info(written, lambda data: data.update(format_version=FORMAT_VERSION + 1))
    with pytest.raises(MapError, match=f"format {FORMAT_VERSION + 1}.*upgrade slimsfm"):
        read_map(written)


@pytest.mark.parametrize("key", ["format_version", "extractor", "box", "unit", "origin"])
@pytest.mark.parametrize("how", ["missing", "null", "word"])
def test_damaged_info_is_a_map_error(written, key, how):
    if key in ("unit", "origin") and how == "word":
        pytest.skip("a word is valid here")
    change_info(
        written, lambda d: d.pop(key) if how == "missing" else d.update({key: {"word": "x"}.get(how)})
    )
    with pytest.raises(MapError, match=r"map\.json: damaged"):
        read_map(written)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", '"map"', "\xff"], ids=repr)
def test_invalid_json_is_a_map_error(written, text):
    (written / "map.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(MapError, match=r"map\.json: damaged"):
        read_map(written)


@pytest.mark.parametrize("part", ["map.json", "features.h5", "sparse", "sparse/images.bin"])
def test_a_missing_part_is_a_map_error(written, part):
    path = written / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(MapError, match=part.split("/")[0].replace("sparse", "not a usable map")):
        read_map(written)


@pytest.mark.parametrize("part", ["features.h5", "matches.h5", "sparse/points3D.bin", "sparse/images.bin"])
def test_a_part_cut_short_is_a_map_error(written, part):
    path = written / part
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MapError, match=f"{part}: damaged"):
        read_map(written)
    change_info(written)
    with pytest.raises(MapError, match="not a usable map"):
        read_map(written)


def test_a_path_that_is_not_a_map_is_a_map_error(tmp_path):
    (tmp_path / "file").write_text("hello")
    for path in (tmp_path, tmp_path / "missing", tmp_path / "file"):
        with pytest.raises(MapError, match=r"not a map \(it has no map.json\)"):
            read_map(path)


def test_an_image_without_features_is_named(written):
    change_info(written)
    with h5py.File(written / "features.h5", "r+") as file:
        del file["003.png"]
    with pytest.raises(MapError, match=r"no features of its image '003\.png'"):
        read_map(written)


def test_more_or_fewer_features_than_keypoints_are_a_map_error(written, exact, tmp_path):
    change_info(written)
    with h5py.File(written / "features.h5", "r+") as file:
        for part, shape in (("keypoints", (10, 2)), ("descriptors", (32, 10)), ("scores", 10)):
            del file["003.png"][part]
            file["003.png"][part] = np.zeros(shape, np.float32)
    with pytest.raises(MapError, match=r"image '003\.png' has 140 keypoints in the model but 10"):
        read_map(written)
    short = {**exact.features, "003.png": exact.features["003.png"][np.arange(10)]}
    with pytest.raises(MapError, match=r"image '003\.png' has 140 keypoints in the model but 10"):
        write_map(replace(exact, features=short), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_map_needs_images_and_points(exact, tmp_path):
    empty = replace(exact, model=pycolmap.Reconstruction())
    with pytest.raises(MapError, match="0 images and 0 points"):
        check_map(empty)
    with pytest.raises(MapError, match="0 images and 0 points"):
        write_map(empty, tmp_path / "map")
    assert list(tmp_path.iterdir()) == []
    check_map(exact_map(2, 10))


def test_a_flipped_bit_is_found_and_its_file_named(written):
    generator = np.random.default_rng(0)
    parts = [path for path in written.rglob("*") if path.is_file()]
    for path in parts * 8:
        data = path.read_bytes()
        place, bit = generator.integers(len(data)), generator.integers(8)
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])
        if path.name == "map.json" and "checksums" not in path.read_text(errors="replace"):
            read_map(written)  # an older map, as far as one can tell
        else:
            with pytest.raises(MapError, match=path.name):
                read_map(written)
        path.write_bytes(data)
    read_map(written)


def test_a_map_without_checksums_opens(written, exact):
    change_info(written)
    assert_equal(read_map(written), exact)


def test_checksums_do_not_depend_on_how_json_is_written(written, exact):
    path = written / "map.json"
    path.write_text(json.dumps(json.loads(path.read_text()), sort_keys=True))
    assert_equal(read_map(written), exact)
