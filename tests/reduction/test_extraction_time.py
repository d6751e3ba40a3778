"""The time of extraction is measured on an image like those of the map."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.errors import InputError
from slimsfm.features import load_extractor
from slimsfm.reduction.extraction_time import extraction_seconds, typical_image

TOLERANCE = 0.4  # of the number of keypoints


def map_with(counts, **options):
    """A map whose images have these numbers of keypoints."""
    made = exact_map(len(counts), 100)
    features = {
        name: one[np.arange(count) % len(one)]
        for (name, one), count in zip(made.features.items(), counts, strict=True)
    }
    return replace(made, features=features, info=replace(made.info, extractor_options=options))


@pytest.mark.parametrize("count", [300, 1500])
def test_the_image_has_the_size_and_the_keypoints_of_the_maps_images(count):
    map_ = map_with([10, count, 4000])
    extractor = load_extractor("sift")
    image = typical_image(map_, extractor)
    camera = map_.shared_camera
    assert image.shape == (camera.height, camera.width, 3)
    assert len(extractor.extract(image)) == pytest.approx(count, rel=TOLERANCE)
    assert np.array_equal(image, typical_image(map_, extractor))


def test_keypoints_are_those_of_the_shrunk_image_where_the_extractor_shrinks():
    map_ = map_with([300] * 3, max_image_size=320)
    extractor = load_extractor("sift", map_.info.extractor_options)
    image = typical_image(map_, extractor)
    assert image.shape == (480, 640, 3)
    assert len(extractor.extract(image)) == pytest.approx(300, rel=TOLERANCE)


def test_each_size_is_measured_once():
    map_ = map_with([300] * 3)
    times = [extraction_seconds(map_, side) for side in (None, 160)]
    assert min(times) > 0
    assert [extraction_seconds(map_, side) for side in (None, 160)] == times


def test_an_extractor_that_is_not_there_is_an_error():
    map_ = map_with([300] * 3)
    lost = replace(map_, info=replace(map_.info, extractor="no such extractor"))
    with pytest.raises(InputError, match="no such extractor"):
        extraction_seconds(lost)
