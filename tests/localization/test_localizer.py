from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from scenes import camera
from slimsfm.errors import MapError
from slimsfm.geometry import corner_error
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import scaled_camera
from slimsfm.photos import read_image
from strategies import CLASSICAL

BLACK = np.zeros((240, 320, 3), np.uint8)


def test_a_black_image_has_no_pose_but_times(boulder):
    found = Localizer(boulder.map).localize(BLACK)
    assert found.pose is None
    assert found.num_matches == 0
    seconds = found.seconds
    assert min(seconds.extract, seconds.match, seconds.pose) > 0
    assert seconds.total == seconds.extract + seconds.match + seconds.pose


def test_a_map_with_several_cameras_needs_a_given_camera(two_cameras):
    known = LocalizationOptions(strategy="exhaustive", focal="known")
    with pytest.raises(ValueError, match="camera must be given"):
        Localizer(two_cameras, known).localize(BLACK)


def test_a_wrong_camera_is_replaced_unless_the_user_insists_on_it(boulder):
    map_, path = boulder.map, boulder.mapping.image_paths[12]
    wrong = pycolmap.Camera(map_.shared_camera.todict())
    wrong.params = wrong.params * [1.3, 1.3, 1, 1]
    truth = map_.images[path.name].cam_from_world()
    found = Localizer(map_).localize(read_image(path), wrong)
    assert (found.camera_source, found.camera_estimated) == ("given", ("focal length",))
    assert corner_error(found.pose.cam_from_world, truth, map_.box) < 0.03
    assert found.camera.mean_focal_length() == pytest.approx(map_.shared_camera.mean_focal_length(), rel=0.02)
    known = LocalizationOptions(focal="known", min_confidence=0.0)
    kept = Localizer(map_, known).localize(read_image(path), wrong)
    assert (kept.camera_estimated, kept.camera.params.tolist()) == ((), wrong.params.tolist())
    assert corner_error(kept.pose.cam_from_world, truth, map_.box) > 0.1
    assert kept.pose.confidence < found.pose.confidence


@pytest.mark.parametrize("strategy", ["exhaustive", "direct"])
@pytest.mark.parametrize("length", [16, 64])
def test_descriptors_of_another_length_than_the_maps_are_an_error(exact, strategy, length):
    query = exact.features["001.png"]
    changed = replace(query, descriptors=np.resize(query.descriptors, (len(query), length)))
    localizer = Localizer(exact, LocalizationOptions(strategy=strategy))
    with pytest.raises(MapError, match=f"map's descriptors have 32 values, those of .*'sift' {length}"):
        localizer.localize_features(changed, camera())
    assert localizer.localize_features(query[np.arange(0)], camera()).pose is None


@pytest.mark.parametrize("shape", [(640, 480, 3), (480, 480, 3)], ids=str)
def test_the_camera_of_the_map_is_not_used_for_another_aspect_ratio(exact, shape):
    with pytest.raises(ValueError, match=f"image of {shape[1]}x{shape[0]}"):
        Localizer(exact, LocalizationOptions(focal="known")).localize(np.zeros(shape, np.uint8))
    assert Localizer(exact).camera_of(np.zeros(shape, np.uint8)).source == "unknown"


def test_a_camera_of_another_size_is_refused(exact):
    with pytest.raises(ValueError, match="size 320x240, got 640x480"):
        Localizer(exact).localize(np.zeros((240, 320, 3), np.uint8), camera())


@pytest.mark.parametrize("strategy", CLASSICAL)
def test_rendered_references_get_their_known_poses(boulder, strategy):
    map_ = boulder.map
    localizer = Localizer(map_, LocalizationOptions(strategy=strategy))
    for path in boulder.mapping.image_paths[4:20:5]:
        found = localizer.localize(read_image(path)).pose
        assert corner_error(found.cam_from_world, map_.images[path.name].cam_from_world(), map_.box) < 0.03


def test_a_resized_image_is_localized_with_the_scaled_camera(boulder):
    map_ = boulder.map
    path = boulder.mapping.image_paths[12]
    small = read_image(path)
    large = np.asarray(cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC), np.uint8)
    localizer = Localizer(map_)
    found = localizer.localize(large).pose.cam_from_world
    assert corner_error(found, map_.images[path.name].cam_from_world(), map_.box) < 0.01
    given = localizer.localize(large, scaled_camera(map_.shared_camera, 640, 480)).pose.cam_from_world
    assert np.array_equal(found.matrix(), given.matrix())


def test_only_rgb_of_eight_bits_is_localized(exact):
    with pytest.raises(ValueError, match="image must be RGB, uint8 of shape"):
        Localizer(exact).camera_of(np.zeros((0, 640, 3), np.uint8))
