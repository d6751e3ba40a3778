"""Features in rounds: sizes, parts of images, and what a search asks for."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.features import load_extractor
from slimsfm.localization import LocalizationOptions, Localizer, MultiLocalizer
from slimsfm.localization.cameras import QueryCamera
from slimsfm.localization.extraction import (
    SMALLEST_SCALE_PX,
    SizedExtractor,
    Window,
    first_size,
    second_size,
)
from slimsfm.localization.rounds import ImageRounds, Seen, StoredRounds, levels_of
from slimsfm.photos import read_image, shrink


@given(whole=st.integers(128, 8000), share=st.floats(0.01, 1.0), first=st.floats(0.05, 0.577))
def test_all_rounds_before_the_last_have_at_most_a_third_of_the_pixels(whole, share, first):
    first_px = int(first * whole)
    second = second_size(whole, first_px, share)
    if second is not None:
        assert first_px < second <= whole
        assert first_px**2 + share * second**2 <= whole**2 / 3 * (1 + 1e-9)


class Recording:
    """A source of features that notes what is asked of it."""

    def __init__(self, source):
        self.source, self.asked = source, []

    def __getattr__(self, name):
        return getattr(self.source, name)

    def at(self, extractor, size):
        self.asked.append(size)
        return self.source.at(extractor, size)

    def part(self, extractor, size, window):
        self.asked.append((size, window))
        return self.source.part(extractor, size, window)


def asked(source, extractor, seen):
    """What is asked of a source if each level gives the same findings."""
    recording = Recording(source)
    levels = levels_of(recording, extractor, "rounds")
    next(levels)
    with suppress(StopIteration):
        while True:
            levels.send(seen)
    return recording.asked


@pytest.fixture(scope="module")
def view(boulder):
    return read_image(boulder.query.image_paths[0])


@pytest.fixture(scope="module")
def extractor(boulder):
    return SizedExtractor(boulder.map)


def test_without_a_pose_images_grow_up_to_the_whole(view, extractor):
    longer = max(view.shape)
    sizes = asked(ImageRounds(view), extractor, Seen())
    assert sizes[0] == first_size(longer)
    assert sizes[-1] == longer
    assert sizes == sorted(set(sizes))


def test_a_pose_that_is_believed_restricts_the_second_round_and_a_sure_one_the_last(view, extractor):
    window = Window(80, 50, 230, 160)
    first, (second, where), last = asked(ImageRounds(view), extractor, Seen(window))
    assert where == window
    assert first < second
    assert last == max(view.shape)
    sure = asked(ImageRounds(view), extractor, Seen(window, is_sure=True))
    assert all(part[1] == window for part in sure[1:])
    assert len(sure) == len({size if isinstance(size, int) else size[0] for size in sure})


def test_the_whole_image_gives_what_the_extractor_gives(view, extractor):
    (level,) = levels_of(ImageRounds(view), extractor, "whole")
    found, expected = level.extracted.features, extractor.whole.extract(view)
    assert level.is_last
    assert level.extracted.shrink_factor == 1
    assert np.array_equal(found.keypoints, expected.keypoints)
    assert np.array_equal(found.descriptors, expected.descriptors)


def test_a_part_has_the_features_of_the_whole_image_in_its_pixels(view, extractor):
    window = Window(60, 40, 260, 200)
    whole = extractor.whole.extract(view).keypoints
    found = extractor.extract(view, None, max(view.shape), window)
    assert found.shrink_factor == 1
    assert found.features.image_size == view.shape[1::-1]
    inner = found.features.keypoints[
        np.all((found.features.keypoints > (90, 70)) & (found.features.keypoints < (230, 170)), axis=1)
    ]
    nearest = np.linalg.norm(inner[:, None] - whole[None], axis=2).min(axis=1)
    assert len(inner) > 20
    assert np.median(nearest) < 0.1


def test_a_shrunken_part_has_the_keypoints_of_the_shrunken_image(view, extractor):
    size, window = max(view.shape) // 2, Window(0, 0, view.shape[1], view.shape[0])
    part = extractor.extract(view, None, size, window)
    image = extractor.extract(view, None, size)
    assert part.shrink_factor == image.shrink_factor == 2
    nearest = np.linalg.norm(part.features.keypoints[:, None] - image.features.keypoints[None], axis=2)
    assert np.median(nearest.min(axis=1)) < 0.2


def test_masked_pixels_hold_no_features_in_any_round(view, extractor):
    mask = np.full(view.shape[:2], 255, np.uint8)
    mask[:, : view.shape[1] // 2] = 0
    source, window = ImageRounds(view, mask), Window(50, 25, 310, 230)
    for found in (source.at(extractor, 200), source.part(extractor, 280, window)):
        assert len(found.features)
        assert found.features.keypoints[:, 0].min() > view.shape[1] / 2 - 3


def test_an_image_as_small_as_the_first_round_is_extracted_at_once(view, extractor):
    small = shrink(view, 120)
    (level,) = levels_of(ImageRounds(small), extractor, "rounds")
    assert level.is_last


def test_the_map_says_which_image_comes_first(view, boulder):
    for first in (128, 150, 180):
        map_ = replace(boulder.map, info=replace(boulder.map.info, first_image_size=first))
        recording = Recording(ImageRounds(view))
        next(levels_of(recording, SizedExtractor(map_), "rounds"))
        assert recording.asked == [first]


def test_stored_features_are_those_that_a_shrunken_image_would_have(boulder, extractor):
    features = boulder.map.features[next(iter(boulder.map.images))]
    source = StoredRounds(features, lambda size: size / 1000)
    whole, small = source.at(extractor, max(features.image_size)), source.at(extractor, 160)
    assert len(whole.features) == len(features) > len(small.features) > 0
    assert small.features.frames[:, 0].min() >= SMALLEST_SCALE_PX * small.shrink_factor
    width, height = features.image_size
    before = source.seconds
    part = source.part(extractor, 160, Window(0, 0, width // 2, height))
    assert part.features.keypoints[:, 0].max() < width / 2
    assert source.seconds - before == pytest.approx(0.08, rel=0.01)


def test_queries_are_found_in_rounds_as_in_the_whole_image(boulder):
    whole = Localizer(boulder.map, LocalizationOptions(extraction="whole"))
    rounds = Localizer(boulder.map)
    for path, pose in zip(boulder.query.image_paths, boulder.query.cam_from_world, strict=True):
        image = read_image(path)
        for one in (whole, rounds):
            found = one.localize(image)
            if found.pose is not None:
                apart = (found.pose.cam_from_world * pose.inverse()).translation
                assert np.linalg.norm(apart) < 0.1 * boulder.map.box.diagonal
        assert (whole.localize(image).pose is None) or (rounds.localize(image).pose is not None)


def test_the_whole_image_is_localized_as_by_its_features(boulder, view):
    localizer = Localizer(boulder.map, LocalizationOptions(extraction="whole"))
    camera = localizer.camera_of(view)
    assert isinstance(camera, QueryCamera)
    features = load_extractor("sift", boulder.map.info.extractor_options).extract(view)
    one, other = localizer.localize(view), localizer.localize_features(features, camera)
    assert np.array_equal(one.pose.cam_from_world.matrix(), other.pose.cam_from_world.matrix())


def test_several_maps_share_extractions_and_each_finds_what_it_finds_alone(boulder, view):
    maps = {
        "early": boulder.map,
        "late": replace(boulder.map, info=replace(boulder.map.info, first_image_size=160)),
    }
    together = MultiLocalizer({name: Localizer(map_) for name, map_ in maps.items()}).localize(view)
    for name, map_ in maps.items():
        alone = Localizer(map_).localize(view)
        assert np.array_equal(together[name].pose.cam_from_world.matrix(), alone.pose.cam_from_world.matrix())
