"""Features belong to a model row by row, image by image, and by what descriptors look like."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from scenes import exact_map, like_sift
from slimsfm.errors import ModelError
from slimsfm.mapping.agreement import place_features, positions
from slimsfm.mapping.lens import fit_pixel_map
from slimsfm.mapping.reprojection import check_reprojection
from slimsfm.mapping.resemblance import check_descriptors

SOURCE = Path("some/features.h5")
CENTER = np.array([320.0, 240.0])


@pytest.fixture(scope="module")
def truth():
    return like_sift(exact_map(num_images=5, num_points=150))


def images_of(model):
    return sorted(model.images.values(), key=lambda image: image.name)


def place(model, features):
    images = images_of(model)
    unusable = {image.name: ~np.isfinite(positions(image)).all(axis=1) for image in images}
    return place_features(images, features, unusable, SOURCE)


def with_keypoints(features, change, names=None):
    """Change the keypoints of some images."""
    return {
        name: replace(one, keypoints=change(one.keypoints).astype(np.float32))
        if names is None or name in names
        else one
        for name, one in features.items()
    }


def moved(model, change):
    """A copy of a model with other keypoints."""
    copy = pycolmap.Reconstruction(model)
    for image in copy.images.values():
        for point, xy in zip(image.points2D, change(positions(image)), strict=True):
            point.xy = xy
    return copy


def distort(pixels, strength):
    centered = (pixels - CENTER) / 500
    return CENTER + (pixels - CENTER) * (1 + strength * (centered**2).sum(axis=1, keepdims=True))


SMOOTH = {
    "barrel distortion": lambda pixels: distort(pixels, -0.15),
    "weak distortion": lambda pixels: distort(pixels, 0.01),
    "half the size": lambda pixels: pixels / 2,
    "a quarter of the size": lambda pixels: pixels / 4,
    "other proportions": lambda pixels: pixels * (0.9, 1.0),
    "a crop": lambda pixels: pixels - (40, 12),
    "half a pixel": lambda pixels: pixels - 0.5,
    "distortion, half the size and a crop": lambda pixels: distort(pixels, -0.1) / 2 + (3, 5),
}


@pytest.mark.parametrize("change", SMOOTH.values(), ids=SMOOTH.keys())
def test_where_keypoints_move_smoothly_those_of_the_model_are_taken(truth, change):
    model = moved(truth.model, change)
    placed, notes = place(model, truth.features)
    for image in images_of(model):
        assert np.allclose(placed[image.name].keypoints, positions(image), atol=1e-4)
        assert np.array_equal(placed[image.name].descriptors, truth.features[image.name].descriptors)
    assert len(notes) == 1
    assert "features.h5: the keypoints of all 5 images lie up to" in notes[0]


@pytest.mark.parametrize("lens", ["OPENCV_FISHEYE", "FOV", "RADIAL"])
@pytest.mark.parametrize("count", [40, 400])
def test_any_lens_that_colmap_undistorts_is_recognized(truth, lens, count):
    """Keypoints far outside of the undistorted image may be anywhere."""
    params = {"OPENCV_FISHEYE": [330, 330, 320, 240, 0.01, 0, 0, 0], "FOV": [400, 400, 320, 240, 0.9]}
    distorted = pycolmap.Camera(
        model=lens, width=640, height=480, params=params.get(lens, [450, 320, 240, -0.25, 0.06]), camera_id=1
    )
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), distorted)
    pinhole.camera_id = 1
    rng = np.random.default_rng(0)
    model, features = pycolmap.Reconstruction(), {}
    model.add_camera_with_trivial_rig(pinhole)
    for image_id, rows in enumerate((400, count), start=1):
        pixels = rng.uniform((0, 0), (640, 480), (rows, 2))
        rays = np.asarray(distorted.cam_from_img(pixels))
        undistorted = np.asarray(pinhole.img_from_cam(np.column_stack([rays, np.ones(rows)])))
        undistorted[3] = (1e6, -1e5)
        image = pycolmap.Image(name=f"{image_id}.png", keypoints=undistorted, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        one = truth.features["001.png"][np.arange(rows) % 170]
        features[image.name] = replace(one, keypoints=pixels.astype(np.float32))
    placed, _ = place(model, features)
    for image in images_of(model):
        assert np.allclose(placed[image.name].keypoints, positions(image), atol=1e-2)
    with pytest.raises(ModelError, match="than all 2 images"):
        place(model, with_keypoints(features, lambda rows: rows[::-1]))


def test_a_change_of_size_changes_the_scales_of_features(truth):
    frames = {
        name: replace(one, frames=np.tile(np.float32([3, 1]), (len(one), 1)))
        for name, one in truth.features.items()
    }
    placed, (note,) = place(moved(truth.model, lambda pixels: pixels / 2), frames)
    assert all(np.allclose(one.frames, (1.5, 1)) for one in placed.values())
    assert "scaled by 0.5" in note


ROUNDINGS = {
    "not at all": lambda pixels: pixels,
    "to single floats": lambda pixels: pixels.astype(np.float32),
    "to half floats": lambda pixels: pixels.astype(np.float16),
    "to hundredths": lambda pixels: pixels.round(2),
    "to whole pixels": np.round,
    "down to whole pixels": np.floor,
    "down, with the origin half a pixel away": lambda pixels: np.floor(pixels - 0.5),
}


@pytest.mark.parametrize("change", ROUNDINGS.values(), ids=ROUNDINGS.keys())
def test_rounded_keypoints_are_accepted_and_those_of_the_features_stay(truth, change):
    placed, notes = place(moved(truth.model, change), truth.features)
    for name, one in truth.features.items():
        assert np.array_equal(placed[name].keypoints, one.keypoints)
    assert len(notes) <= 1
    assert all("as by rounding" in note for note in notes)


ORDERS = {
    "reversed": lambda rows: rows[::-1],
    "shuffled": lambda rows: np.random.default_rng(0).permutation(rows),
    "shifted by one": lambda rows: np.roll(rows, 1, axis=0),
    "sorted": lambda rows: rows[np.lexsort(rows.T)],
    "halves swapped": lambda rows: np.roll(rows, len(rows) // 2, axis=0),
}


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
@pytest.mark.parametrize("names", [("002.png",), ("001.png", "004.png"), None])
def test_rows_of_another_order_are_an_error_that_names_every_image(truth, order, names):
    with pytest.raises(ModelError, match="the same keypoints in another order") as error:
        place(truth.model, with_keypoints(truth.features, order, names))
    if names is None:
        assert "all 5 images" in str(error.value)
    else:
        assert [name for name in truth.images if repr(name) in str(error.value)] == list(names)
    assert str(error.value).startswith(str(SOURCE))


@pytest.mark.parametrize("seen_through", ["the same lens", "another lens"])
def test_swapped_images_are_both_named(truth, seen_through):
    """Also if both have as many keypoints, and if all others differ smoothly."""
    one, other = "002.png", "004.png"
    assert len(truth.features[one]) == len(truth.features[other])
    swapped = {**truth.features, one: truth.features[other], other: truth.features[one]}
    model = (
        truth.model if seen_through == "the same lens" else moved(truth.model, SMOOTH["barrel distortion"])
    )
    with pytest.raises(ModelError, match=r"2 images \('002\.png', '004\.png'\).*px away"):
        place(model, swapped)


TURNS = {
    "half a turn": lambda pixels: 2 * CENTER - pixels,
    "a quarter of a turn": lambda pixels: pixels[:, ::-1] * (1, -1) + (0, 640),
    "a mirror": lambda pixels: pixels * (-1, 1) + (640, 0),
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS.keys())
def test_turned_and_mirrored_images_are_named(truth, turn):
    with pytest.raises(ModelError, match=r"1 image \('003\.png'\).*turned by .* or mirrored"):
        place(truth.model, with_keypoints(truth.features, turn, ("003.png",)))


def test_images_of_few_keypoints_are_compared_by_the_lens_of_the_others(truth):
    """Three keypoints could be moved anywhere by a map of their own."""
    few, rows = "005.png", np.arange(3)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(truth.camera(few))
    for name, image in truth.images.items():
        kept = positions(image)[rows] if name == few else positions(image)
        copy = pycolmap.Image(
            name=name, keypoints=SMOOTH["barrel distortion"](kept), camera_id=1, image_id=image.image_id
        )
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    features = {**truth.features, few: truth.features[few][rows]}
    placed, _ = place(model, features)
    assert np.allclose(placed[few].keypoints, positions(images_of(model)[4]), atol=1e-4)
    with pytest.raises(ModelError, match=r"1 image \('005\.png'\)"):
        place(model, with_keypoints(features, lambda pixels: pixels[::-1], (few,)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_match_nothing_and_are_counted(truth, value):
    one = truth.features["002.png"]
    floats = one.descriptors.astype(np.float16)
    floats[4, 9] = value
    keypoints = one.keypoints.copy()
    keypoints[6, 1] = value
    scores = one.scores.copy()
    scores[3] = value
    damaged = replace(one, descriptors=floats, keypoints=keypoints, scores=scores)
    placed, (note,) = place(truth.model, {**truth.features, "002.png": damaged})
    assert "2 features of 1 image ('002.png') are not finite" in note
    kept = placed["002.png"]
    for values in (kept.keypoints, kept.descriptors, kept.scores):
        assert np.isfinite(values).all()
    assert not kept.descriptors[4].any()
    assert np.allclose(kept.keypoints, one.keypoints, atol=1e-4)


def test_features_that_are_mostly_not_finite_are_an_error(truth):
    with pytest.raises(ModelError, match=r"all 5 images.*no finite position of most"):
        place(truth.model, with_keypoints(truth.features, lambda pixels: pixels * np.nan))


def test_descriptors_of_another_order_are_named(truth):
    images = images_of(truth.model)
    check_descriptors(images, truth.features, SOURCE)
    for wrong in (["003.png"], ["001.png", "004.png"]):
        mixed = {
            name: replace(one, descriptors=np.random.default_rng(seed).permutation(one.descriptors))
            if name in wrong
            else one
            for seed, (name, one) in enumerate(truth.features.items())
        }
        with pytest.raises(ModelError, match="of its descriptors like those of the same points") as error:
            check_descriptors(images, mixed, SOURCE)
        assert [name for name in truth.images if repr(name) in str(error.value)] == wrong
    empty = {name: replace(one, descriptors=0 * one.descriptors) for name, one in truth.features.items()}
    with pytest.raises(ModelError, match="all descriptors are zero"):
        check_descriptors(images, empty, SOURCE)


def test_points_that_project_to_their_keypoints_are_right(truth):
    assert check_reprojection(truth.model, images_of(truth.model), SOURCE) == []
    noise = np.random.default_rng(0)
    noisy = moved(truth.model, lambda pixels: pixels + noise.normal(0, 1.5, pixels.shape))
    assert check_reprojection(noisy, images_of(noisy), SOURCE) == []


@pytest.mark.parametrize(
    "change",
    [lambda pixels: distort(pixels, -1), SMOOTH["half the size"], SMOOTH["a crop"]],
    ids=["distortion", "half the size", "a crop"],
)
def test_keypoints_of_another_version_of_the_images_are_named(truth, change):
    model = moved(truth.model, change)
    with pytest.raises(ModelError, match=r"camera 1 \(OPENCV\) are up to .* px beside its points"):
        check_reprojection(model, images_of(model), SOURCE)


def test_small_systematic_and_large_random_errors_are_noted(truth):
    model = moved(truth.model, lambda pixels: distort(pixels, 0.5))
    (note,) = check_reprojection(model, images_of(model), SOURCE)
    assert "as if its lens were another" in note
    noise = np.random.default_rng(0)
    model = moved(truth.model, lambda pixels: pixels + noise.normal(0, 5, pixels.shape))
    (note,) = check_reprojection(model, images_of(model), SOURCE)
    assert "the median reprojection error of all 5 images is up to" in note


def test_images_with_each_others_poses_are_named(truth):
    model = pycolmap.Reconstruction(truth.model)
    one, other = (model.image(i) for i in (2, 3))
    poses = [image.cam_from_world() for image in (one, other)]
    for image, pose in zip((other, one), poses, strict=True):
        model.frame(image.frame_id).rig_from_world = pose
    with pytest.raises(ModelError, match=r"2 images \('002\.png', '003\.png'\) see do not project"):
        check_reprojection(model, images_of(model), SOURCE)


@pytest.mark.parametrize("count", [8, 9, 30, 63, 200])
def test_a_map_is_fitted_with_a_degree_that_its_rows_allow(count):
    pixels = np.random.default_rng(0).uniform(0, 500, (count, 2))
    found = fit_pixel_map(pixels, 0.5 * pixels + (3, 4))
    if count < 9:
        assert found is None
    else:
        assert found is not None
        assert found.degree == {9: 1, 30: 3, 63: 5, 200: 5}[count]
        assert np.allclose(found(pixels), 0.5 * pixels + (3, 4))
        assert found.scale == pytest.approx(0.5)
        assert found.turn_deg == pytest.approx(0, abs=1e-6)
