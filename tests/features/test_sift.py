import json

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial import KDTree

from slimsfm.errors import InputError
from slimsfm.features import Extractor, image_colors, load_extractor, unit_rows
from slimsfm.features.sift import Sift


@pytest.fixture(scope="module")
def found(textured):
    return Sift().extract(textured)


def test_the_contract_of_extractors_is_kept(textured):
    extractor = load_extractor("sift")
    assert isinstance(extractor, Extractor)
    assert extractor.name == "sift"
    assert load_extractor("sift", json.loads(json.dumps(extractor.options))) == extractor
    one, two = (extractor.extract(textured) for _ in range(2))
    for array in ("keypoints", "descriptors", "scores"):
        assert np.array_equal(getattr(one, array), getattr(two, array))
    assert one.image_size == (320, 240)
    assert len(one) == len(one.descriptors) == len(one.scores) > 100
    assert ((one.keypoints > 0) & (one.keypoints < (320, 240))).all()
    assert np.linalg.norm(unit_rows(one.descriptors), axis=1) == pytest.approx(1, abs=1e-5)
    mask = np.zeros(textured.shape[:2], np.uint8)
    assert len(extractor.extract(textured, mask)) == 0
    nothing = extractor.extract(np.zeros_like(textured))
    assert nothing.keypoints.shape == (0, 2)
    assert nothing.descriptors.shape == (0, one.descriptors.shape[1])
    assert nothing.descriptors.dtype == one.descriptors.dtype
    assert nothing.scores.shape == (0,)


def colmap_features(image):
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False)
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    return np.array([(k.x, k.y) for k in keypoints]), np.asarray(descriptors.data)


def test_keypoints_and_descriptors_are_those_of_colmap(textured, found):
    keypoints, descriptors = colmap_features(textured)
    tree, ours = KDTree(keypoints), KDTree(found.keypoints)
    distances, theirs = tree.query(found.keypoints)
    back = ours.query(keypoints)[1]
    mutual = (found.keypoints[back[theirs]] == found.keypoints).all(axis=1)
    assert mutual.mean() > 0.9
    assert np.mean(distances[mutual] < 0.05) > 0.9
    assert abs(len(keypoints) - len(found)) < 0.2 * len(found)
    # A keypoint of several directions is there several times, in COLMAP at most twice.
    groups = ours.query_ball_point(keypoints, 0.05)
    mine, other = unit_rows(found.descriptors), unit_rows(descriptors)
    cosines = np.array([(mine[rows] @ other[i]).max() for i, rows in enumerate(groups) if rows])
    assert np.median(cosines) > 0.99
    assert np.mean(cosines > 0.95) > 0.85


@pytest.mark.parametrize("shift", [(8, 0), (0, 16), (24, 8)])
def test_a_shifted_image_has_its_keypoints_shifted(textured, shift):
    # By multiples of 8 pixels, which the coarse octaves sample alike.
    x, y = shift
    whole = Sift().extract(textured[: 240 - y, : 320 - x])
    moved = Sift().extract(textured[y:, x:])
    inner = np.all((moved.keypoints > 60) & (moved.keypoints < np.array([320 - x, 240 - y]) - 60), axis=1)
    distances = KDTree(whole.keypoints - np.float32(shift)).query(moved.keypoints[inner])[0]
    assert inner.sum() > 100
    assert np.mean(distances < 1e-3) > 0.95


def test_a_blob_is_found_at_its_centre_in_pixels_of_colmap():
    y, x = np.mgrid[:64, :96] + 0.5
    blob = np.exp(-((x - 40.5) ** 2 + (y - 30.5) ** 2) / (2 * 4.0**2))
    image = np.repeat((40 + 200 * blob)[..., None], 3, axis=2).astype(np.uint8)
    found = Sift().extract(image)
    assert np.linalg.norm(found.keypoints - (40.5, 30.5), axis=1).min() < 0.02


def test_the_strongest_features_are_kept(textured, found):
    assert np.all(np.diff(found.scores) <= 0)
    for count in (1, 50, 200):
        few = Sift(max_features=count).extract(textured)
        assert len(few) == count
        assert np.sort(few.scores) == pytest.approx(np.sort(found.scores[:count]))


def test_there_is_no_feature_where_the_mask_is_black(textured, found):
    mask = np.zeros((240, 320), np.uint8)
    mask[60:180, 100:250] = 255
    kept = Sift().extract(textured, mask)
    columns, rows = kept.keypoints.astype(int).T
    assert (mask[rows, columns] > 0).all()
    inside = np.all((found.keypoints > (102, 62)) & (found.keypoints < (248, 178)), axis=1)
    assert len(kept) >= inside.sum() > 100


@pytest.mark.parametrize("size", [160, 214])
def test_keypoints_of_a_shrunk_image_are_given_in_the_image_itself(textured, size):
    large = cv2.resize(textured, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    small = cv2.resize(large, (size, round(size * 0.75)), interpolation=cv2.INTER_AREA)
    found = Sift(max_image_size=size).extract(large)
    expected = Sift().extract(small)
    assert found.image_size == (960, 720)
    factors = np.array([960 / small.shape[1], 720 / small.shape[0]])
    distances = KDTree(expected.keypoints * factors).query(found.keypoints)[0]
    assert np.median(distances) < 0.3
    assert found.keypoints.max(axis=0) == pytest.approx((960, 720), rel=0.1)


def test_a_mask_shrinks_with_its_image(textured):
    mask = np.zeros((240, 320), np.uint8)
    mask[:, :160] = 255
    found = Sift(max_image_size=160).extract(textured, mask)
    assert len(found) > 30
    assert found.keypoints[:, 0].max() < 162


def test_rows_of_features_can_be_chosen(found):
    rows = np.array([5, 2, 2])
    chosen = found[rows]
    assert np.array_equal(chosen.keypoints, found.keypoints[rows])
    assert np.array_equal(chosen.descriptors, found.descriptors[rows])
    assert chosen.image_size == found.image_size


def test_unit_rows_keep_zeros():
    rows = unit_rows(np.array([[3, 4], [0, 0]], np.uint8))
    assert rows == pytest.approx(np.array([[0.6, 0.8], [0, 0]]))


def test_colours_are_those_of_the_pixel_around_a_keypoint(textured):
    keypoints = np.array([[0.0, 0.0], [10.5, 20.5], [10.99, 20.01], [319.9, 239.9], [320, 240]], np.float32)
    corner = textured[239, 319]
    expected = [textured[0, 0], textured[20, 10], textured[20, 10], corner, corner]
    assert np.array_equal(image_colors(textured, keypoints), expected)


@pytest.mark.parametrize(
    "values", [{"max_features": 0}, {"max_image_size": 8}, {"contrast_threshold": 0.0}], ids=str
)
def test_bad_options_are_named(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        Sift(**values)
    with pytest.raises(InputError, match=next(iter(values))):
        load_extractor("sift", values)


def test_unknown_extractors_and_options_are_input_errors():
    with pytest.raises(
        InputError, match="'magic' is unknown; known are aliked, disk, loftr, sift, superpoint, xfeat"
    ):
        load_extractor("magic")
    with pytest.raises(InputError, match=r"'sift'.*colour"):
        load_extractor("sift", {"colour": True})


def test_frames_are_colmaps_scales_and_orientations(textured, found):
    """COLMAP keeps affine shapes; its scale and orientation are those of LightGlue's SIFT."""
    gray = cv2.cvtColor(textured, cv2.COLOR_RGB2GRAY)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False)
    keypoints, _ = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu).extract(
        pycolmap.Bitmap.from_array(gray)
    )
    tree = KDTree([(k.x, k.y) for k in keypoints])
    frames = np.array([(k.compute_scale(), k.compute_orientation()) for k in keypoints])
    near = tree.query_ball_point(
        found.keypoints, 0.05
    )  # a keypoint of several orientations is there as often
    pairs = [(ours, frames[rows]) for ours, rows in zip(found.frames, near, strict=True) if rows]
    assert len(pairs) > 100
    ratios = [ours[0] / theirs[0, 0] for ours, theirs in pairs]
    turns = [np.abs(np.angle(np.exp(1j * (ours[1] - theirs[:, 1])))).min() for ours, theirs in pairs]
    assert np.median(ratios) == pytest.approx(1, abs=0.02)
    assert np.median(turns) < 0.1  # histograms of gradients are read out differently


@pytest.mark.parametrize("size", [160, 320])
def test_no_keypoint_lies_on_a_black_pixel_and_masked_ones_do_not_count(textured, size):
    mask = np.zeros((240, 320), np.uint8)
    mask[60:180, 100:250] = np.random.default_rng(0).random((120, 150)) > 0.1
    whole = Sift(max_image_size=size).extract(textured)
    inside = Sift(max_image_size=size).extract(textured, mask)
    columns, rows = inside.keypoints.astype(int).T
    assert (mask[rows, columns] > 0).all()
    count = len(inside) // 2
    strongest = Sift(max_image_size=size, max_features=count).extract(textured, mask)
    assert len(strongest) == count < len(whole) / 4
    assert np.array_equal(strongest.keypoints, inside.keypoints[:count])
