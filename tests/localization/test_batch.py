import json
import shutil

import numpy as np
import pytest
from PIL import Image as PillowImage

from outcomes import assert_same_outcomes
from slimsfm.errors import ImageError, InputError
from slimsfm.localization import (
    LocalizationOptions,
    Localizer,
    MultiLocalizer,
    localize_images,
    localize_objects,
)
from slimsfm.localization.cameras import read_gravity
from slimsfm.localization.pose_files import write_object_poses, write_poses
from slimsfm.photos import read_image
from slimsfm.pose.priors import Gravity


def test_a_folder_gives_the_same_outcomes_as_its_images_one_by_one(boulder):
    localizer = Localizer(boulder.map)
    names = [path.name for path in boulder.query.image_paths]
    alone = {name: localizer.localize(read_image(boulder.queries / name)) for name in sorted(names)}
    assert sum(one.pose is not None for one in alone.values()) > 0
    for workers in (None, 1, 3):
        assert_same_outcomes(localize_images(localizer, boulder.queries, workers=workers), alone)
    first = sorted(names)[0]
    assert_same_outcomes(localize_images(localizer, str(boulder.queries / first)), {first: alone[first]})


def test_progress_takes_one_step_per_image(boulder):
    seen = []

    def progress(items, label):
        for item in items:
            seen.append(label)
            yield item

    results = localize_images(Localizer(boulder.map), boulder.queries, progress=progress)
    assert seen == ["localize (progressive)"] * len(results)


def test_gravity_is_used_for_the_images_that_have_it(boulder):
    localizer = Localizer(boulder.map)
    plain = localize_images(localizer, boulder.queries)
    (first, *rest) = plain
    cam_from_world = plain[first].pose.cam_from_world
    down = np.array([0.0, 0.0, -1.0])
    gravity = {first: Gravity(in_world=down, in_cam=cam_from_world.rotation.matrix() @ down)}
    upright = localize_images(localizer, boulder.queries, gravity=gravity)
    assert not np.array_equal(upright[first].pose.cam_from_world.matrix(), cam_from_world.matrix())
    assert_same_outcomes({name: upright[name] for name in rest}, {name: plain[name] for name in rest})


def test_several_objects_are_searched_in_each_image(boulder, tmp_path):
    localizers = {name: Localizer(boulder.map) for name in ("one", "other")}
    results = localize_objects(MultiLocalizer(localizers), boulder.queries)
    assert list(results) == ["one", "other"]
    alone = localize_images(localizers["one"], boulder.queries)
    for of_object in results.values():
        assert_same_outcomes(of_object, alone)
    write_object_poses(str(tmp_path / "poses.json"), results)
    images = json.loads((tmp_path / "poses.json").read_text())["images"]
    assert [(one["name"], one["object"]) for one in images] == [
        (name, key) for name in alone for key in results
    ]


def test_results_are_written_to_a_path_that_is_a_string(boulder, tmp_path):
    results = localize_images(Localizer(boulder.map), str(boulder.queries))
    write_poses(str(tmp_path / "poses.json"), results)
    images = json.loads((tmp_path / "poses.json").read_text())["images"]
    assert [one["name"] for one in images] == list(results)


def test_bad_input_is_refused_before_the_work_begins(boulder, tmp_path):
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        localize_images(Localizer(boulder.map), boulder.queries, workers=0)
    with pytest.raises(InputError, match="no such folder"):
        localize_images(Localizer(boulder.map), tmp_path / "missing")
    PillowImage.new("RGB", (240, 320)).save(tmp_path / "upright.png")
    known = Localizer(boulder.map, LocalizationOptions(focal="known"))
    with pytest.raises(ImageError, match=r"upright\.png: its focal length is unknown"):
        localize_images(known, tmp_path)


def test_gravity_is_read_by_image_name(tmp_path):
    path = tmp_path / "gravity.json"
    path.write_text(json.dumps({"world": [0, 0, -9.8], "images": {"a.jpg": [0, 9.8, 0]}}))
    gravity = read_gravity(str(path))
    assert list(gravity) == ["a.jpg"]
    assert np.array_equal(gravity["a.jpg"].in_world, [0, 0, -9.8])
    assert np.array_equal(gravity["a.jpg"].in_cam, [0, 9.8, 0])
    for text in ("", "{}", '{"world": [0, 0, 1], "images": []}', '{"world": [0, 1], "images": {}}'):
        path.write_text(text)
        with pytest.raises(InputError, match=r"gravity\.json: should hold"):
            read_gravity(path)


def test_transparent_pixels_of_queries_hold_no_features(boulder, tmp_path):
    path = boulder.query.image_paths[0]
    image = read_image(path)
    half = image.shape[1] // 2
    alpha = np.full(image.shape[:2], 255, np.uint8)
    alpha[:, :half] = 0
    PillowImage.fromarray(np.dstack([image, alpha])).save(tmp_path / "a.png")
    localizer = Localizer(boulder.map, LocalizationOptions(min_confidence=0.0))
    (found,) = localize_images(localizer, tmp_path).values()
    assert found.num_matches > 0
    assert found.points2D[:, 0].min() >= half
    assert_same_outcomes({"a": found}, {"a": localizer.localize(image, mask=alpha)})


def test_images_that_are_skipped_are_said(boulder, tmp_path, caplog):
    shutil.copy(boulder.query.image_paths[0], tmp_path / "a.png")
    (tmp_path / "b.nef").write_bytes(b"")
    assert list(localize_images(Localizer(boulder.map), tmp_path)) == ["a.png"]
    assert "1 raw file skipped: b.nef" in caplog.text


def test_an_image_whose_name_cannot_be_listed_is_refused_alone_too(boulder, tmp_path):
    path = tmp_path / "a\nb.png"
    shutil.copy(boulder.query.image_paths[0], path)
    with pytest.raises(InputError, match="line break"):
        localize_images(Localizer(boulder.map), path)
