from itertools import pairwise

import numpy as np
import pytest

from scenes import BOX, camera, poses
from slimsfm.arrays import evenly_spaced
from slimsfm.geometry import project
from slimsfm.methods.onepose.crop import (
    LOOKED_AT,
    FoundPoints,
    Region,
    RegionVote,
    box_region,
    crop_region,
    locate_object,
    region_by_matches,
)
from slimsfm.synthetic.scene import look_at


def region(left, top, right, bottom) -> Region:
    return Region(left=float(left), top=float(top), right=float(right), bottom=float(bottom))


OBJECT = region(60, 100, 180, 160)


def picture_of_dots(points2D: np.ndarray) -> np.ndarray:
    """Round white dots centered at the given pixels."""
    rows, columns = np.mgrid[:240, :320] + 0.5
    distances = np.hypot(columns[..., None] - points2D[:, 0], rows[..., None] - points2D[:, 1])
    bright = np.exp(-(distances**2) / 8).sum(axis=2)
    return np.repeat((255 * bright).round().astype(np.uint8)[..., None], 3, axis=2)


def center_of(image: np.ndarray) -> np.ndarray:
    light = image[:, :, 0].astype(float)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return np.array([(light * columns).sum(), (light * rows).sum()])[None] / light.sum()


@pytest.mark.parametrize(
    "where",
    [
        region(20, 30, 148, 158),
        region(40.25, 50.5, 140.75, 100),
        region(0, 0, 320, 240),
        region(90, 60, 110, 90),
        region(-100, -150, 300, 240),
    ],
    ids=["translation", "between pixels", "whole", "enlarged", "beyond the border"],
)
def test_a_dot_keeps_its_pixels_through_a_crop(where):
    dot = np.array([[100.3, 77.6]])
    for size in (64, 128):
        crop = crop_region(picture_of_dots(dot), where, size)
        assert crop.image.shape == (size, size, 3)
        assert crop.to_image(center_of(crop.image)) == pytest.approx(dot, abs=0.05 * max(1, crop.scale))


def test_a_square_of_the_right_size_is_copied_exactly():
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    crop = crop_region(image, region(20, 30, 84, 94), 64)
    np.testing.assert_array_equal(crop.image, image[30:94, 20:84])
    np.testing.assert_array_equal(crop.to_image(np.zeros((1, 2))), [[20, 30]])


def test_a_crop_has_the_longer_side_and_is_black_beyond_the_border():
    crop = crop_region(np.full((100, 50, 3), 200, np.uint8), region(0, 0, 50, 100), 100)
    assert (crop.image[:, 26:74] == 200).all()
    assert (crop.image[:, :24] == 0).all()
    assert (crop.image[:, 76:] == 0).all()


def test_fine_texture_is_averaged_when_shrunk():
    rows, columns = np.mgrid[:240, :320]
    chessboard = np.repeat((255 * ((rows + columns) % 2)).astype(np.uint8)[..., None], 3, axis=2)
    crop = crop_region(chessboard, region(0, 0, 192, 192), 64)
    assert np.abs(crop.image.astype(float) - 127).max() < 20


def test_the_region_of_a_box_bounds_its_corners():
    cam_from_world = poses(6)[1]
    found = box_region(BOX, cam_from_world, camera())
    corners = project(BOX.corners, cam_from_world, camera())
    assert (found.left, found.top) == pytest.approx(corners.min(axis=0))
    assert (found.right, found.bottom) == pytest.approx(corners.max(axis=0))


def test_the_region_of_a_partly_visible_box_is_clipped():
    found = box_region(BOX, look_at(np.array([5.0, 0, 0]), np.array([0, 3.2, 0])), camera())
    assert min(found.left, 640 - found.right) == 0
    assert 0 < found.right - found.left < 320


@pytest.mark.parametrize(
    ("eye", "target"),
    [((5, 0, 0), (10, 0, 0)), ((5, 0, 0), (0, 9, 0)), ((0.5, 0, 0), (0, 0, 0)), ((500, 0, 0), (0, 0, 0))],
    ids=["behind", "next to it", "around the camera", "too small"],
)
def test_an_invisible_box_has_no_region(eye, target):
    cam_from_world = look_at(np.array(eye, float), np.array(target, float))
    assert box_region(BOX, cam_from_world, camera()) is None


def similar(points2D: np.ndarray) -> np.ndarray:
    """Rotated by 90 degrees, twice as large, and shifted."""
    return 2 * points2D @ np.array([[0, 1], [-1, 0]]) + (500, -20)


def test_matches_map_the_region_despite_outliers():
    rng = np.random.default_rng(0)
    reference = rng.uniform(60, 180, (40, 2))
    query = similar(reference) + rng.normal(0, 0.5, (40, 2))
    query[25:] = rng.uniform(0, 480, (15, 2))
    found = region_by_matches(query, reference, OBJECT, (640, 480))
    corners = similar(OBJECT.corners)
    assert found.inliers >= 25
    assert (found.region.left, found.region.top) == pytest.approx(corners.min(axis=0), abs=3)
    assert (found.region.right, found.region.bottom) == pytest.approx(corners.max(axis=0), abs=3)
    assert region_by_matches(query, reference, OBJECT, (640, 480)) == found


def test_too_few_or_contradicting_matches_locate_nothing():
    rng = np.random.default_rng(0)
    one, other = rng.uniform(0, 400, (2, 12, 2))
    assert region_by_matches(one, other, OBJECT, (640, 480)) is None
    assert region_by_matches(similar(one[:5]), one[:5], OBJECT, (640, 480)) is None
    assert region_by_matches(similar(one), one, OBJECT, (640, 480)) is not None
    assert region_by_matches(similar(one) + 2000, one, OBJECT, (640, 480)) is None


def test_the_region_with_the_most_inliers_wins():
    votes = [None, *(RegionVote(region=region(n, 0, 99, 99), inliers=n) for n in (7, 12, 9))]
    assert locate_object(votes).region == region(12, 0, 99, 99)
    assert locate_object([None, None]) == (None, 2)


def found(*points: int, at: float) -> FoundPoints:
    return FoundPoints(np.array(points, np.int64), np.full((len(points), 2), at))


def test_a_later_look_takes_precedence():
    both = found(5, 2, at=9.0).added_to(found(1, 2, 3, at=4.0))
    assert dict(zip(both.points.tolist(), both.points2D[:, 0].tolist(), strict=True)) == {
        5: 9.0,
        2: 9.0,
        1: 4.0,
        3: 4.0,
    }
    matches = both.matches(references=3)
    assert matches.points2D is both.points2D
    assert np.array_equal(matches.keypoints, np.arange(4))
    assert matches.references == 3


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 400])
def test_images_to_match_are_evenly_spaced(count):
    rows = evenly_spaced(count, LOOKED_AT)
    assert len(rows) == min(count, 15)
    assert set(rows) <= set(range(count))
    gaps = [b - a for a, b in pairwise(rows)]
    assert not gaps or 1 <= min(gaps) >= max(gaps) - 1


def test_no_further_image_is_matched_once_one_has_enough_inliers():
    regions = [Region(left=float(n), top=0.0, right=99.0, bottom=99.0) for n in range(4)]
    votes = [None, *(RegionVote(region=regions[n], inliers=n_in) for n, n_in in enumerate((20, 40, 80, 200)))]
    asked = iter(votes)
    located = locate_object(asked)
    assert located.region == regions[2]
    assert located.references == 4
    assert len(list(asked)) == 1
    assert locate_object(votes[:3]) == (regions[1], 3)
    assert locate_object([]) == (None, 0)
