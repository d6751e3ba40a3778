"""Maps for direct matching."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import camera, exact_map
from slimsfm.errors import MapError
from slimsfm.features import unit_rows
from slimsfm.geometry import corner_error
from slimsfm.graph import EDGE_SOURCES, GraphOptions, compute_graph
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import PointDescriptors, check_map
from slimsfm.mapping.subset import direct_map, keep_images, with_points
from slimsfm.reduction import FrontierOptions, frontier

HALF_A_STEP = 0.5 / 15  # of the range between the smallest and the largest value


def described(map_, rows):
    rows = np.asarray(rows, np.int64)
    return PointDescriptors(points=rows, descriptors=describe_points(map_).descriptors[rows])


@pytest.fixture(scope="module")
def chosen(exact):
    return described(exact, np.arange(0, len(exact.point3D_ids), 3))


@pytest.fixture(scope="module")
def direct(exact, chosen):
    return direct_map(exact, chosen)


@pytest.fixture(scope="module")
def partial():
    """A map whose images each observe half of the points."""
    return exact_map(8, 60, reach_deg=80)


def test_chosen_points_stay_as_they_were(exact, chosen, direct):
    check_map(direct)
    assert np.array_equal(direct.point3D_ids, exact.point3D_ids[chosen.points])
    assert np.array_equal(direct.points3D_in_world, exact.points3D_in_world[chosen.points])
    assert np.array_equal(direct.colors, exact.colors[chosen.points])
    assert np.array_equal(direct.point_descriptors.points, np.arange(len(chosen.points)))
    assert np.array_equal(direct.point_descriptors.descriptors, chosen.descriptors)


def test_images_keep_their_poses_but_not_their_features(exact, direct):
    assert list(direct.images) == list(exact.images)
    for name, image in direct.images.items():
        before = exact.images[name]
        assert (image.image_id, image.camera_id) == (before.image_id, before.camera_id)
        assert np.array_equal(image.cam_from_world().matrix(), before.cam_from_world().matrix())
        assert repr(direct.camera(name)) == repr(exact.camera(name))
        assert image.num_points2D() == 0
    assert all(point.track.length() == 0 for point in direct.model.points3D.values())
    assert (len(direct.features), len(direct.matches)) == (0, 0)
    assert direct.info is exact.info


def repeated(map_, rows, counts):
    """Some points with several descriptors each."""
    one = described(map_, rows)
    return one[np.repeat(np.arange(len(one.points)), counts)]


def test_a_kept_point_keeps_all_of_its_appearances(exact, tmp_path):
    rows = np.arange(0, len(exact.point3D_ids), 3)
    counts = np.arange(len(rows)) % 3 + 1
    whole = repeated(exact, rows, counts)
    some = whole.of(rows[1::2])
    assert np.array_equal(some.points, np.repeat(rows[1::2], counts[1::2]))
    for made in (direct_map(exact, some), with_points(keep_images(exact, ["001.png"]), exact, some)):
        kept = made.point3D_ids[made.point_descriptors.points]
        assert np.array_equal(kept, exact.point3D_ids[some.points])
        assert np.array_equal(made.point_descriptors.descriptors, some.descriptors)
        write_map(made, tmp_path / made.kind)
        again = read_map(tmp_path / made.kind)
        assert np.array_equal(again.point_descriptors.points, made.point_descriptors.points)
        assert f"{len(rows[1::2])} " in again.describe()


def test_only_maps_with_several_descriptors_per_point_have_the_later_format(exact, chosen, tmp_path):
    several = repeated(exact, chosen.points, 2)
    for name, points, version in (("one", chosen, 1), ("several", several, 2)):
        write_map(direct_map(exact, points), tmp_path / name)
        assert json.loads((tmp_path / name / "map.json").read_text())["format_version"] == version
        assert read_map(tmp_path / name).point_descriptors is not None


def test_the_full_map_does_not_change(exact, chosen):
    before = exact.fingerprint
    direct_map(exact, chosen)
    assert replace(exact).fingerprint == before


def test_a_direct_map_is_read_as_it_was_written_up_to_rounding(direct, tmp_path):
    write_map(direct, tmp_path / "map")
    assert sorted(path.name for path in (tmp_path / "map").iterdir()) == ["map.json", "points.npz", "sparse"]
    again = read_map(tmp_path / "map")
    assert list(again.images) == list(direct.images)
    for name, image in again.images.items():
        pose = direct.images[name].cam_from_world().matrix()
        assert np.array_equal(image.cam_from_world().matrix(), pose)
    assert np.array_equal(again.point3D_ids, direct.point3D_ids)
    assert np.array_equal(again.points3D_in_world, direct.points3D_in_world)
    assert np.array_equal(again.point_descriptors.points, direct.point_descriptors.points)
    before, after = direct.point_descriptors.descriptors, again.point_descriptors.descriptors
    assert np.linalg.norm(after, axis=1) == pytest.approx(np.ones(len(after)))
    assert (after * before).sum(axis=1).min() > 0.98


def test_writing_twice_gives_equal_files(direct, tmp_path):
    for name in ("one", "two"):
        write_map(direct, tmp_path / name)
    write_map(read_map(tmp_path / "one"), tmp_path / "copy")
    for file in (path for path in (tmp_path / "one").rglob("*") if path.is_file()):
        place = file.relative_to(tmp_path / "one")
        assert file.read_bytes() == (tmp_path / "two" / place).read_bytes()
        if file.name not in ("points.npz", "map.json"):
            assert file.read_bytes() == (tmp_path / "copy" / place).read_bytes()


def test_the_size_of_a_direct_map_is_the_sum_of_its_parts(exact, direct, tmp_path):
    write_map(exact, tmp_path / "full")
    write_map(direct, tmp_path / "direct")
    sizes = bytes_by_part(tmp_path / "direct")
    assert list(sizes) == ["map.json", "points.npz", "sparse", "total"]
    assert sizes["total"] == sum(size for part, size in sizes.items() if part != "total")
    assert sizes["total"] < bytes_by_part(tmp_path / "full")["total"] / 5


def test_the_model_opens_in_pycolmap(direct, tmp_path):
    write_map(direct, tmp_path / "map")
    model = pycolmap.Reconstruction(tmp_path / "map" / "sparse")
    assert model.num_reg_images() == len(direct.images)
    assert model.num_points3D() == len(direct.point3D_ids)
    assert model.compute_num_observations() == 0


def test_a_map_without_chosen_points_is_read(exact, tmp_path):
    write_map(exact, tmp_path / "map")
    assert not (tmp_path / "map" / "points.npz").exists()
    again = read_map(tmp_path / "map")
    assert again.point_descriptors is None
    assert len(again.features) == len(exact.features)


@pytest.mark.parametrize("strategy", ["auto", "direct"])
def test_references_are_localized_where_they_are(direct, exact, tmp_path, strategy):
    write_map(direct, tmp_path / "map")
    for map_ in (direct, read_map(tmp_path / "map")):
        localizer = Localizer(map_, LocalizationOptions(strategy=strategy))
        for name, image in exact.images.items():
            found = localizer.localize_features(exact.features[name], camera()).pose
            assert found.num_inliers == len(direct.point3D_ids)
            assert corner_error(found.cam_from_world, image.cam_from_world(), exact.box) < 1e-4


def test_points_added_to_some_images_serve_both_ways_of_matching(partial, tmp_path):
    names = list(partial.images)[:2]
    slim = keep_images(partial, names)
    chosen = described(partial, np.arange(1, len(partial.point3D_ids), 2))
    both = with_points(slim, partial, chosen)
    write_map(both, tmp_path / "map")
    wanted = partial.point3D_ids[chosen.points]
    assert set(both.point3D_ids) == set(wanted) | set(slim.point3D_ids) > set(slim.point3D_ids)
    for map_ in (both, read_map(tmp_path / "map")):
        assert list(map_.images) == names
        assert map_.model.is_valid()
        assert np.array_equal(map_.point3D_ids[map_.point_descriptors.points], wanted)
        for name in names:
            seen, before = map_.observations[name], slim.observations[name]
            assert np.array_equal(seen.rows, before.rows)
            assert np.array_equal(map_.point3D_ids[seen.points], slim.point3D_ids[before.points])
            for strategy in ("exhaustive", "direct"):
                localizer = Localizer(map_, LocalizationOptions(strategy=strategy))
                found = localizer.localize_features(partial.features[name], camera()).pose
                truth = partial.images[name].cam_from_world()
                assert corner_error(found.cam_from_world, truth, partial.box) < 1e-3
    assert slim.model.num_points3D() == len(slim.point3D_ids)


def test_keeping_images_of_a_map_for_both_ways_drops_the_points(partial):
    names = list(partial.images)
    both = with_points(keep_images(partial, names), partial, described(partial, [0, 5]))
    assert keep_images(both, names[:3]).point_descriptors is None


@pytest.mark.parametrize(
    "use",
    [
        *(
            lambda map_, one=one: compute_graph(map_, GraphOptions(edges=one))
            for one in ("auto", *EDGE_SOURCES)
        ),
        lambda map_: Localizer(map_, LocalizationOptions(strategy="exhaustive")),
        lambda map_: keep_images(map_, list(map_.images)[:2]),
        lambda map_: frontier(map_, FrontierOptions(uses=("direct",))),
    ],
    ids=["auto", *EDGE_SOURCES, "exhaustive", "keep_images", "frontier"],
)
def test_errors_about_missing_features_name_the_map_that_has_them(direct, use):
    with pytest.raises(MapError, match=r"direct matching alone.*use the map that it was reduced from"):
        use(direct)


def test_descriptors_need_not_be_of_unit_length_to_be_written(exact, chosen, tmp_path):
    longer = replace(chosen, descriptors=7 * chosen.descriptors)
    write_map(direct_map(exact, longer), tmp_path / "map")
    read = read_map(tmp_path / "map").point_descriptors.descriptors
    assert read == pytest.approx(unit_rows(read))
    assert (read * chosen.descriptors).sum(axis=1).min() > 1 - HALF_A_STEP


def test_a_map_says_what_it_was_reduced_to(exact, chosen, direct):
    few = keep_images(exact, list(exact.images)[:1])
    joined = with_points(few, exact, chosen)
    kinds = [one.kind for one in (exact, direct, few, joined)]
    assert kinds == ["full", "points", "images", "images and points"]
    points, images = len(chosen.points), len(exact.images)
    origin = f"({exact.info.origin})"
    assert direct.describe() == f"{points} points for direct matching, reduced from {images} images {origin}"
    assert exact.describe() == f"{images} images with {len(exact.point3D_ids)} points {origin}"
    reduced = f"reduced from a larger map {origin}"
    assert few.describe() == f"1 image with {len(few.point3D_ids)} points, {reduced}"
    assert joined.describe() == (
        f"1 image with {len(joined.point3D_ids)} points, {points} of them for direct matching, {reduced}"
    )


def test_the_kind_survives_writing_and_reading(exact, chosen, direct, tmp_path):
    few = keep_images(exact, list(exact.images)[:1])
    for number, one in enumerate((exact, direct, few, with_points(few, exact, chosen))):
        write_map(one, str(tmp_path / str(number)))
        assert read_map(str(tmp_path / str(number))).describe() == one.describe()
