from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import exact_map, with_matches
from slimsfm.errors import InputError, MapError
from slimsfm.graph import compute_graph
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images
from slimsfm.upkeep.forget import ForgetOptions, forget
from slimsfm.upkeep.missed_points import count_misses


@pytest.fixture(scope="module")
def scene():
    """Twenty images all around that see every point."""
    return with_matches(exact_map(20, 60))


@pytest.fixture(scope="module")
def with_ghosts():
    """Many images, and points that only two of them have keypoints of although all should see them."""
    scene = with_matches(exact_map(90, 25))
    model = pycolmap.Reconstruction(scene.model)
    names = list(scene.images)[:2]
    ghosts = []
    for row in (-1, -2, -3):
        track = pycolmap.Track()
        for name in names:
            image = scene.images[name]
            track.add_element(image.image_id, image.num_points2D() + row)
        ghosts.append(model.add_point3D(np.array([0.1 * row, 0.1, 0.2]), track, np.zeros(3, np.uint8)))
    return replace(scene, model=model), ghosts


def test_nothing_is_missed_in_an_exact_map(scene):
    assert not count_misses(scene).missed.any()
    found = forget(scene, ForgetOptions(max_images=len(scene.images)))
    assert found.map is scene
    assert (found.images, len(found.missed_points), found.orphaned_points) == ((), 0, 0)
    assert found.before == found.after == 100


def test_points_that_have_gone_are_forgotten(with_ghosts):
    map_, ghosts = with_ghosts
    found = forget(map_)
    assert found.missed_points.tolist() == ghosts
    assert len(found.map.point3D_ids) == len(map_.point3D_ids) - len(ghosts)
    assert list(found.map.images) == list(map_.images)
    check_map(found.map)
    assert len(map_.point3D_ids) == len(found.map.point3D_ids) + 3  # the map itself does not change


def test_images_that_others_replace_are_dropped(scene):
    found = forget(scene, ForgetOptions(max_images=16))
    assert len(found.map.images) == 16
    assert set(found.images) == set(scene.images) - set(found.map.images)
    assert found.tests == found.images
    assert found.map.info.origin.endswith(", 4 images forgotten")
    for name, image in found.map.images.items():
        assert np.array_equal(image.cam_from_world().matrix(), scene.images[name].cam_from_world().matrix())
    again = forget(found.map, ForgetOptions(max_images=14))
    assert again.map.info.origin.endswith(", 6 images forgotten")


def test_of_equal_images_the_older_one_is_dropped():
    twice = exact_map(6, 100)  # every image sees every point, so that any of them replaces any other
    ids = {name: image.image_id for name, image in twice.images.items()}
    found = forget(with_matches(twice), ForgetOptions(max_images=3), graph=compute_graph(twice).graph)
    assert found.images == tuple(sorted(ids, key=lambda name: ids[name])[:3])


def test_wrong_input_is_named(scene):
    with pytest.raises(ValueError, match="max_images"):
        ForgetOptions(max_images=1)
    other = compute_graph(keep_images(scene, list(scene.images)[:5])).graph
    with pytest.raises(InputError, match="graph"):
        forget(scene, ForgetOptions(max_images=4), graph=other)
    with pytest.raises(MapError, match="reduced"):
        forget(keep_images(scene, list(scene.images)[:1]))
