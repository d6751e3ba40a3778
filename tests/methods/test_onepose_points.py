from dataclasses import replace

import numpy as np
import pytest

from scenes import BOX, exact_map
from slimsfm.errors import MapError
from slimsfm.geometry import Box
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.methods.onepose.points import OnePosePointsOptions, prepare_points


@pytest.fixture(scope="module")
def scene() -> Map:
    """Tracks of two to five images, a box around half of the points, descriptors that differ everywhere."""
    made = exact_map(num_images=9, num_points=200, seed=3, reach_deg=80)
    rng = np.random.default_rng(4)
    features = {
        name: replace(one, descriptors=rng.normal(size=(len(one), 8)).astype(np.float32))
        for name, one in made.features.items()
    }
    box = Box(np.array([0.1, 0, 0]), BOX.half_edges * 0.8)
    return replace(made, features=features, info=replace(made.info, box=box))


def by_the_rule(map_: Map, longest: int, distance: float) -> list[tuple[set, set]]:
    """For each group its points and its observations (image, feature), read off the rule one by one."""
    low, high = map_.box.corners.min(axis=0), map_.box.corners.max(axis=0)
    observations: dict[int, set] = {}
    for name, seen in map_.observations.items():
        for row, point in zip(seen.rows.tolist(), seen.points.tolist(), strict=True):
            observations.setdefault(point, set()).add((name, row))
    xyz = map_.points3D_in_world
    inside = [point for point in sorted(observations) if np.all((xyz[point] > low) & (xyz[point] < high))]
    lengths = {point: len(observations[point]) for point in inside}
    least = min(
        length for length in lengths.values() if sum(other > length for other in lengths.values()) <= longest
    )
    kept = [point for point in inside if lengths[point] >= least]
    groups, taken = [], set()
    for point in kept:
        near = {other for other in kept if np.linalg.norm(xyz[point] - xyz[other]) < distance} | {point}
        if not near & taken:
            taken |= near
            groups.append((near, set().union(*(observations[one] for one in near))))
    return groups


@pytest.mark.parametrize(("longest", "distance"), [(2500, 0.25), (30, 0.25), (30, 1e-3), (1, 0.4)])
def test_points_are_those_of_the_rule(scene, longest, distance):
    options = OnePosePointsOptions(max_points=longest, merge_m=distance, leaves=4)
    found = prepare_points(scene, options)
    groups = by_the_rule(scene, longest, distance)
    assert len(found.points) == len(groups)
    for row, (members, observations) in enumerate(groups):
        xyz = scene.points3D_in_world[sorted(members)]
        nearest = sorted(members)[int(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).argmin())]
        assert found.points[row] == nearest
        described = np.array([scene.features[name].descriptors[i] for name, i in sorted(observations)])
        assert np.allclose(found.descriptors[row], described.mean(axis=0), atol=1e-6)
        leaves = {leaf.tobytes() for leaf in found.leaves[row]}
        ones = np.ones(8, np.float32).tobytes()
        assert leaves - {ones} <= {one.tobytes() for one in described}
        assert len(leaves - {ones}) == min(4, len(described))
        assert (ones in leaves) == (len(described) < 4)


def test_equal_seeds_draw_equal_observations_and_others_others(scene):
    one, again, other = (
        prepare_points(scene, OnePosePointsOptions(leaves=2, seed=seed)).leaves for seed in (0, 0, 1)
    )
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_all_points_are_taken_where_none_is_in_the_box(scene):
    elsewhere = replace(scene, info=replace(scene.info, box=Box(np.full(3, 50.0), np.eye(3))))
    found = prepare_points(elsewhere, OnePosePointsOptions(leaves=0))
    assert found.points.tolist() == list(range(len(scene.point3D_ids)))
    assert found.leaves.shape == (len(found.points), 0, 8)


def test_points_are_left_in_a_map_of_one_image(scene):
    name = next(iter(scene.images))
    alone = keep_images(scene, [name])
    found = prepare_points(alone)
    assert 10 < len(found.points) <= len(scene.observations[name].points)
    assert np.allclose(found.descriptors, found.leaves.sum(axis=1) - 7, atol=1e-5)


def test_in_maps_of_unknown_unit_points_merge_within_a_share_of_the_diagonal(scene):
    unknown = replace(scene, info=replace(scene.info, unit="unknown"))
    share = 0.2 / scene.box.diagonal
    one = prepare_points(unknown, OnePosePointsOptions(merge_share=share))
    other = prepare_points(scene, OnePosePointsOptions(merge_m=0.2))
    assert np.array_equal(one.points, other.points)
    assert len(one.points) < len(prepare_points(scene).points)


def test_a_map_for_direct_matching_alone_is_refused(scene):
    with pytest.raises(MapError, match="direct matching alone"):
        prepare_points(direct_map(scene, describe_points(scene)))


@pytest.mark.parametrize(
    "wrong", [{"max_points": 0}, {"merge_m": -1.0}, {"merge_share": -0.1}, {"leaves": -1}]
)
def test_options_must_make_sense(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        OnePosePointsOptions(**wrong)
