"""A city is a map like any other, whose pairs grow with its images."""

from itertools import combinations

import numpy as np
import pytest

from city import CityOptions, city_map
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.graph.edge_sources import covisible_pairs
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import check_map


def city(images=60, **options):
    return city_map(CityOptions(images=images, keypoints=200, **options))


@pytest.fixture(scope="module")
def small():
    return city()


def test_it_is_a_valid_map(small):
    check_map(small)
    assert small.model.is_valid()
    assert len(small.images) == len(small.features) == 60
    for name, image in small.images.items():
        features = small.features[name]
        assert np.allclose(features.keypoints, [point.xy for point in image.points2D], atol=1e-3)
        assert 30 < len(small.observations[name].rows) < 160 <= len(features)
    in_box = (small.points3D_in_world - small.box.center) @ np.linalg.inv(small.box.half_edges)
    assert np.abs(in_box).max() <= 1 + 1e-9


def test_points_lie_where_keypoints_see_them(small):
    for name, image in small.images.items():
        seen = small.observations[name]
        pixels = small.camera(name).img_from_cam(
            image.cam_from_world() * small.points3D_in_world[seen.points]
        )
        off = np.array([image.points2D[row].xy for row in seen.rows.tolist()]) - pixels
        assert np.std(off) == pytest.approx(0.5, rel=0.3)


def test_covisible_pairs_grow_with_the_images_and_no_faster():
    counts = {images: len(covisible_pairs(city(images), 12)) for images in (300, 600, 1200)}
    per_image = [count / images for images, count in counts.items()]
    assert min(per_image) > 4
    assert max(per_image) < 1.2 * min(per_image)


def test_the_second_lap_sees_the_places_of_the_first(small):
    pairs = {tuple(pair) for pair in covisible_pairs(small, 12).tolist()}
    for number in range(30):
        assert (number, number + 30) in pairs
        assert (number, number + 15) not in pairs
    single = {tuple(pair) for pair in covisible_pairs(city(laps=1), 12).tolist()}
    assert not any((number, number + 30) in single for number in range(30))


def test_matches_join_keypoints_that_see_the_same_point(small):
    rows_to_points = {
        name: dict(zip(seen.rows.tolist(), seen.points.tolist(), strict=True))
        for name, seen in small.observations.items()
    }
    for (a, b), matches in small.matches.items():
        assert a < b
        assert len(matches) > 12
        of_a, of_b = rows_to_points[a], rows_to_points[b]
        assert all(of_a[i] == of_b[j] for i, j in matches.tolist())
        assert len(matches) == len(set(of_a.values()) & set(of_b.values()))
    covisible = {tuple(pair) for pair in covisible_pairs(small, 12).tolist()}
    index = {name: number for number, name in enumerate(small.images)}
    assert {(index[a], index[b]) for a, b in small.matches} <= covisible


@pytest.mark.parametrize("edges", ["matches", "tracks", "localize"])
def test_neighbors_localize_each_other(small, edges):
    adjacency = compute_graph(small, GraphOptions(edges=edges)).graph.adjacency().toarray()
    assert all(adjacency[i, i + 1] and adjacency[i + 1, i] for i in range(59))
    assert all(adjacency[i, i + 30] and adjacency[i + 30, i] for i in range(30))
    assert adjacency.sum() < 60 * 59 / 2


def test_a_written_city_can_be_read(small, tmp_path):
    write_map(small, tmp_path / "city")
    read = read_map(tmp_path / "city")
    assert list(read.images) == list(small.images)
    assert np.array_equal(read.points3D_in_world, small.points3D_in_world)
    assert set(read.matches) == set(small.matches)
    for pair in list(read.matches)[::20]:
        assert sorted(read.matches[pair].tolist()) == sorted(small.matches[pair].tolist())
    options = GraphOptions(edges="matches")
    by_both = [compute_graph(map_, options).graph.adjacency().toarray() for map_ in (small, read)]
    assert np.array_equal(*by_both)


def test_equal_options_make_equal_cities_and_another_seed_another(small):
    again, other = city(), city(seed=1)
    name = next(iter(small.images))
    assert np.array_equal(again.points3D_in_world, small.points3D_in_world)
    assert np.array_equal(again.features[name].descriptors, small.features[name].descriptors)
    assert not np.array_equal(other.features[name].keypoints, small.features[name].keypoints)


@pytest.mark.parametrize("values", [{"images": 39}, {"laps": 0}, {"images": 100, "laps": 6}])
def test_a_city_that_is_too_small_is_an_error(values):
    with pytest.raises(ValueError, match="images must be at least 20 per lap"):
        CityOptions(**values)


def test_every_pair_of_images_that_has_matches_is_listed_once(small):
    listed = list(small.matches)
    assert len(set(listed)) == len(listed) == len(small.matches)
    assert set(listed) <= set(combinations(small.images, 2))
