import numpy as np
import pytest
from scipy.sparse import csr_array

from scenes import algorithm_1, exact_map
from slimsfm.domination import DominationProblem, exact
from slimsfm.reduction.image_sets import (
    reach,
    rim_groups,
    rim_sectors,
    surface_parts,
    viewing_directions,
)


def cap(rings_deg, an_image_each_deg):
    """Directions on rings around the z axis; the first is at its own angle from the axis."""
    found = []
    for polar in np.radians(rings_deg):
        count = max(1, round(360 * np.sin(polar) / an_image_each_deg))
        azimuths = 2 * np.pi * np.arange(count) / count
        ones = np.ones(count)
        level = [np.sin(polar) * np.cos(azimuths), np.sin(polar) * np.sin(azimuths), np.cos(polar) * ones]
        found.append(np.stack(level, axis=1))
    return np.concatenate(found)


def within(directions, reach_deg):
    """Each image localizes those within an angle."""
    return csr_array(directions @ directions.T >= np.cos(np.radians(reach_deg)))


def sphere(count):
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    azimuths = np.pi * (3 - 5**0.5) * np.arange(count)
    level = np.sqrt(1 - z**2)
    return np.stack([level * np.cos(azimuths), level * np.sin(azimuths), z], axis=1)


def polar_deg(directions):
    return np.degrees(np.arccos(np.clip(directions[:, 2], -1, 1)))


def sectors(directions, reach_deg=35.0):
    found = list(rim_sectors(directions, within(directions, reach_deg)))
    return np.array(found, bool).reshape(-1, len(directions))


HEMISPHERE = cap([0, 15, 30, 45, 60, 75, 90], 15)


@pytest.mark.parametrize("count", [60, 100, 300])
def test_a_full_sphere_has_no_rim(count):
    assert len(sectors(sphere(count))) == 0


def test_the_rim_of_a_hemisphere_is_its_outermost_ring_and_each_sector_keeps_to_it():
    found = sectors(HEMISPHERE)
    outermost = polar_deg(HEMISPHERE) > 89
    assert len(found) == outermost.sum()
    assert np.array_equal(found.any(axis=0), outermost)


def test_without_the_rim_a_hemisphere_is_dominated_from_farther_in_than_with_it():
    adjacency = within(HEMISPHERE, 35)
    plain = exact(DominationProblem(adjacency)).chosen
    kept = exact(DominationProblem(adjacency, groups=csr_array(sectors(HEMISPHERE)))).chosen
    assert len(kept) >= len(plain)

    def farthest_deg(chosen):
        """From a query at the rim, or 12 degrees beyond it, to a kept image."""
        azimuths = np.radians(np.arange(0, 360, 5))
        polar = np.radians(102)
        flat = np.sin(polar) * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
        queries = np.column_stack([flat, np.full(len(flat), np.cos(polar))])
        cosines = queries @ HEMISPHERE[list(chosen)].T
        return np.degrees(np.arccos(cosines.max(axis=1))).max()

    assert farthest_deg(kept) < farthest_deg(plain)
    assert farthest_deg(kept) <= 40


@pytest.mark.parametrize("polar", [50.0, 70.0, 90.0])
def test_a_ring_has_a_rim_above_and_one_below_and_none_along_it(polar):
    ring = cap([polar], 15)
    found = sectors(ring)
    assert len(found) == 2 * len(ring)
    spans = np.degrees(np.arccos(np.clip(ring @ ring.T, -1, 1)))
    assert all(spans[np.ix_(members, members)].max() > 30 for members in found)


def test_three_rings_have_their_rims_at_the_highest_and_the_lowest():
    rings = cap([50, 65, 80], 15)
    found = sectors(rings, reach_deg=20)
    assert not found[:, np.isclose(polar_deg(rings), 65)].any()
    assert all(len(np.unique(polar_deg(rings)[members].round())) == 1 for members in found)


def test_the_rim_of_a_wall_seen_from_one_side_is_around_its_views():
    x, y = np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7))
    eyes = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    found = sectors(eyes / np.linalg.norm(eyes, axis=1, keepdims=True), 15)
    around = np.maximum(abs(eyes[:, 0]), abs(eyes[:, 1])) > 0.99
    corner = np.minimum(abs(eyes[:, 0]), abs(eyes[:, 1])) > 0.99
    assert len(found) == around.sum()
    assert not found[:, np.maximum(abs(eyes[:, 0]), abs(eyes[:, 1])) < 0.5].any()
    assert found[:, corner].any(axis=0).all()


def test_an_image_far_from_all_others_is_no_rim():
    assert len(sectors(np.eye(3))) == 0


def test_images_in_one_place_are_no_neighbours():
    assert len(sectors(np.tile([[0.0, 0, 1]], (4, 1)))) == 0


def test_the_reach_is_where_fewer_than_nine_of_ten_pairs_localize_each_other():
    views = sphere(200)
    assert abs(reach(views, within(views, 30)) - 32) <= 2
    assert reach(views, csr_array((200, 200), dtype=bool)) == 0
    assert reach(views, csr_array(np.ones((200, 200), bool))) == 180


@pytest.mark.parametrize("seed", range(3))
def test_sectors_do_not_depend_on_the_order_of_the_images(seed):
    order = np.random.default_rng(seed).permutation(len(HEMISPHERE))
    one, other = sectors(HEMISPHERE), sectors(HEMISPHERE[order])
    assert {frozenset(np.flatnonzero(m).tolist()) for m in one} == {
        frozenset(order[m].tolist()) for m in other
    }


@pytest.mark.parametrize("seed", range(3))
def test_sectors_do_not_depend_on_how_the_world_is_turned(seed):
    turned = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    one, other = sectors(HEMISPHERE), sectors(HEMISPHERE @ turned.T)
    assert {m.tobytes() for m in one} == {m.tobytes() for m in other}


@pytest.fixture(scope="module")
def narrow():
    return exact_map(num_images=12, num_points=1500, reach_deg=65.0)


def test_each_part_of_the_surface_has_an_image_that_sees_the_most_of_it(narrow):
    parts = list(surface_parts(narrow))
    assert len(parts) > 10
    assert all(members.any() and not members.all() for members in parts)


def test_parts_of_few_points_do_not_count():
    assert list(surface_parts(exact_map(num_points=40))) == []


def test_groups_of_a_map_are_not_empty_nor_twice_and_all_are_kept_by_a_solution(narrow):
    adjacency = algorithm_1(narrow).adjacency()
    groups = rim_groups(narrow, adjacency)
    dense = groups.toarray()
    assert dense.any(axis=1).all()
    assert len(np.unique(dense, axis=0)) == len(dense)
    chosen = exact(DominationProblem(adjacency, groups=groups)).chosen
    assert dense[:, list(chosen)].any(axis=1).all()
    assert len(chosen) >= len(exact(DominationProblem(adjacency)).chosen)


def test_directions_lead_from_the_box_to_the_cameras(narrow):
    directions = viewing_directions(narrow)
    for direction, image in zip(directions, narrow.images.values(), strict=True):
        eye = image.projection_center() - narrow.box.center
        assert np.allclose(direction * np.linalg.norm(eye), eye)
