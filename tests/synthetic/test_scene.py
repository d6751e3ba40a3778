import cv2
import numpy as np
import pytest

from slimsfm.geometry import project
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.render import Light, Scene, visible_meshes
from slimsfm.synthetic.scene import mapping_take, object_box, query_take


def features_on_object(take, index):
    gray = cv2.cvtColor(take.frame(index), cv2.COLOR_RGB2GRAY)
    mask = (visible_meshes(take.scene, take.camera, take.cam_from_object[index]) == 0).astype(np.uint8)
    return len(cv2.SIFT_create(4000, contrastThreshold=0.02).detect(gray, mask))


@pytest.mark.parametrize("name", OBJECTS)
def test_every_object_but_the_plain_box_gives_hundreds_of_features(name):
    count = features_on_object(mapping_take(name, 60, 640, 480, 0), 20)
    assert (30 < count < 250) if name == "plain_box" else count > 400


@pytest.mark.parametrize("name", ["ball", "tiled_box"])
def test_queries_hide_some_of_the_object_in_some_frames_but_never_much(name):
    take = query_take(name, 40, 80, 60, 0)
    alone = Scene([OBJECTS[name](0)], Light())
    hidden = []
    for pose in take.cam_from_object:
        whole, seen = (np.sum(visible_meshes(scene, take.camera, pose) == 0) for scene in (alone, take.scene))
        hidden.append(1 - seen / whole)
    assert max(hidden) < 0.37
    assert np.mean(np.array(hidden) > 0.1) > 0.08


@pytest.mark.parametrize("take_of", [mapping_take, query_take])
def test_the_object_is_seen_inside_its_projected_box(take_of):
    take = take_of("plain_box", 4, 320, 240, 0)
    for pose in take.cam_from_object:
        corners = project(object_box(OBJECTS["plain_box"](0)).corners, pose, take.camera)
        hull = cv2.convexHull(corners.astype(np.float32))
        y, x = np.nonzero(visible_meshes(take.scene, take.camera, pose) == 0)
        rim = cv2.convexHull(np.stack([x, y], axis=1).astype(np.float32) + 0.5)[:, 0]
        distances = [cv2.pointPolygonTest(hull, (float(a), float(b)), True) for a, b in rim]
        assert min(distances) > -0.1


def test_frames_are_equal_for_equal_arguments_and_noise_differs_between_frames():
    one, two = (mapping_take("can", 4, 64, 48, seed=5) for _ in range(2))
    assert np.array_equal(one.frame(2), two.frame(2))
    assert not np.array_equal(one.frame(1), one.frame(2))


def test_an_unknown_object_is_an_error():
    with pytest.raises(ValueError, match="name must be one of"):
        mapping_take("teapot", 1, 64, 48, 0)
