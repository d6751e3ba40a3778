from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")

from detector_free import SphereMatcher  # noqa: E402
from networks.seeded import fill  # noqa: E402
from scenes import BOX, camera, poses  # noqa: E402
from slimsfm.errors import InputError, MapError  # noqa: E402
from slimsfm.features import Features  # noqa: E402
from slimsfm.geometry import corner_error, project  # noqa: E402
from slimsfm.localization.strategy import PointMatches, PoseGuided, Query, Strategy  # noqa: E402
from slimsfm.mapping.map import Map  # noqa: E402
from slimsfm.mapping.subset import keep_images  # noqa: E402
from slimsfm.methods.loftr.network import make_network  # noqa: E402
from slimsfm.methods.onepose.crop import Region, box_region, crop_region  # noqa: E402
from slimsfm.methods.onepose_plus.network import CoarseToFine, OnePosePlusMatcher  # noqa: E402
from slimsfm.methods.onepose_plus.strategy import OnePosePlusStrategy, PhotoObjectFinder  # noqa: E402
from slimsfm.pose import PoseEstimate, estimate_pose  # noqa: E402
from slimsfm.weights import Runtime, use_runtime  # noqa: E402

VIEW = poses(6)[1]
PICTURE = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
WHOLE = Region(left=0.0, top=0.0, right=640.0, bottom=480.0)
CROP_PX = 64


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder of seeded weights under the names of the published ones."""
    folder = tmp_path_factory.mktemp("weights")
    networks = {
        "OnePosePlus_model.ckpt": OnePosePlusMatcher(),
        "LoFTR_wsize9.ckpt": make_network(window=9, coarse_context=False),
    }
    for file, network in networks.items():
        fill(network, 0)
        state = {f"matcher.{key}": value for key, value in network.state_dict().items()}
        torch.save({"state_dict": state}, folder / file)
    return folder


@pytest.fixture(autouse=True)
def runtime(weights):
    with use_runtime(Runtime(weights=weights, device="cpu")):
        yield


@pytest.fixture(scope="module")
def plain(exact) -> Map:
    """The exact scene as a map built without a detector, without photos."""
    rng = np.random.default_rng(1)
    described = {
        name: replace(one, descriptors=rng.normal(size=(len(one), 384)).astype(np.float16))
        for name, one in exact.features.items()
    }
    info = replace(exact.info, extractor="loftr", extractor_options={"weights": "loftr-onepose++"})
    return replace(exact, features=described, info=info)


@pytest.fixture(scope="module")
def pictured(plain) -> Map:
    """The same map with photos at a tenth of the cameras' resolution."""
    rng = np.random.default_rng(2)
    photos = {name: rng.integers(0, 256, (48, 64, 3), dtype=np.uint8) for name in plain.images}
    info = replace(plain.info, extractor_options={**plain.info.extractor_options, "max_image_size": 64})
    return replace(plain, photos=photos, info=info)


def query(image: np.ndarray | None) -> Query:
    nothing = Features(
        keypoints=np.zeros((0, 2), np.float32),
        descriptors=np.zeros((0, 0), np.float32),
        scores=np.zeros(0, np.float32),
        image_size=(640, 480),
    )
    return Query(
        keypoints=np.zeros((0, 2)),
        descriptors=nothing.descriptors,
        features=nothing,
        camera=camera(),
        image=image,
    )


def strategy_of(map_: Map, network=None) -> OnePosePlusStrategy:
    return OnePosePlusStrategy(map_, network=network, crop_px=CROP_PX)


def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255


class Oracle:
    """A network that knows where the camera was; fails unless it gets crops around `regions`, in order."""

    def __init__(self, map_: Map, regions: list[Region]) -> None:
        self.pixels = project(map_.points3D_in_world, VIEW, camera())
        self.regions = regions

    def __call__(self, image, *_described) -> CoarseToFine:
        crop = crop_region(PICTURE, self.regions.pop(0), CROP_PX)
        np.testing.assert_allclose(image[0, 0], gray(crop.image), atol=1e-6)
        in_crop = (self.pixels - (crop.left, crop.top)) / crop.scale - 0.5
        shown = np.flatnonzero(np.all((in_crop > 0) & (in_crop < image.shape[2] - 1), axis=1))
        return found_at(in_crop[shown], shown)


def found_at(points2D: np.ndarray, points: np.ndarray) -> CoarseToFine:
    rows = torch.from_numpy(points)
    return CoarseToFine(
        confidence=torch.zeros(1, 0, 0),
        batches=torch.zeros_like(rows),
        points=rows,
        cells=rows,
        points2D=torch.from_numpy(points2D.astype(np.float32)),
        scores=torch.ones(len(rows)),
    )


def pose_of(map_: Map, matches: PointMatches) -> PoseEstimate:
    points3D_in_world = map_.points3D_in_world[matches.points]
    pose = estimate_pose(matches.pixels(query(None)), points3D_in_world, camera())
    assert pose is not None
    return pose


def test_points_are_found_in_a_query_without_a_pose_and_always_the_same(pictured):
    any_confidence = OnePosePlusMatcher(threshold=0.0).eval().requires_grad_(False)
    fill(any_confidence, 0)
    strategy = strategy_of(keep_images(pictured, list(pictured.images)[:2]), any_confidence)
    first, again = (list(strategy.rounds(query(PICTURE))) for _ in range(2))
    matches = first[-1]
    assert len(np.unique(matches.points)) == len(matches) > 0
    assert np.all((matches.pixels(query(None)) >= 0) & (matches.pixels(query(None)) <= (640, 480)))
    assert len(first) == len(again)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.points2D, other.points2D)


def test_a_query_without_an_image_has_no_matches(plain):
    strategy = strategy_of(plain)
    assert [len(matches) for matches in strategy.rounds(query(None))] == [0]
    assert len(strategy.near(query(None), VIEW)) == 0


def test_it_is_a_pose_guided_strategy_without_visible_points(plain):
    strategy = strategy_of(plain)
    assert isinstance(strategy, Strategy)
    assert isinstance(strategy, PoseGuided)
    descriptors, points = strategy.visible_points(VIEW)
    assert len(descriptors) == len(points) == 0


def test_a_point_is_described_by_the_mean_of_its_remaining_observations(plain):
    reduced = keep_images(plain, list(plain.images)[:2])
    given = []

    def network(_image, _points3D, coarse, fine):
        given.append(np.concatenate([coarse[0], fine[0]]).T)
        return found_at(np.zeros((0, 2)), np.zeros(0, np.int64))

    strategy_of(reduced, network).near(query(PICTURE), VIEW)
    (both,) = given
    for row in (0, 7, 119):
        seen = [
            reduced.features[name].descriptors[observed.rows[observed.points == row]]
            for name, observed in reduced.observations.items()
        ]
        np.testing.assert_allclose(both[row], np.concatenate(seen).astype(float).mean(axis=0), atol=1e-5)


def test_pixels_of_the_crop_become_those_of_the_query(plain):
    dot = np.array([251.3, 177.6])
    rows, columns = np.mgrid[:480, :640] + 0.5
    light = 255 * np.exp(-((rows - dot[1]) ** 2 + (columns - dot[0]) ** 2) / 200)
    image = np.repeat(light.round().astype(np.uint8)[..., None], 3, axis=2)

    def center_of_light(gray, *_described):
        weights = gray[0, 0].numpy() / gray.numpy().sum()
        across, down = weights.sum(axis=0) @ np.arange(64), weights.sum(axis=1) @ np.arange(64)
        return found_at(np.array([[across, down]]), np.array([3]))

    strategy = strategy_of(plain, center_of_light)
    for matches in (strategy.near(query(image), VIEW), next(strategy.rounds(query(image)))):
        np.testing.assert_array_equal(matches.points, [3])
        np.testing.assert_allclose(matches.pixels(query(image)), [dot], atol=0.1)


def test_a_network_that_knows_where_points_are_localizes(plain):
    """The first look is at the whole image, the second where the pose projects the box."""
    oracle = Oracle(plain, [WHOLE])
    rounds = strategy_of(plain, oracle).rounds(query(PICTURE))
    pose = pose_of(plain, next(rounds))
    assert corner_error(pose.cam_from_world, VIEW, BOX) < 1e-4
    closer = box_region(BOX, pose.cam_from_world, camera())
    assert closer is not None
    assert closer.side < 0.9 * WHOLE.side
    oracle.regions.append(closer)
    again = pose_of(plain, rounds.send(pose))
    assert corner_error(again.cam_from_world, VIEW, BOX) < 1e-4
    assert oracle.regions == []


def test_a_later_look_updates_a_point_and_forgets_none(plain):
    looks = iter([([1, 5, 7], 10.0), ([5, 9], 20.0)])

    def two_looks(_gray, *_described):
        points, place = next(looks)
        return found_at(np.full((len(points), 2), place), np.array(points))

    rounds = strategy_of(plain, two_looks).rounds(query(PICTURE))
    first = next(rounds)
    points3D = plain.points3D_in_world
    pose = estimate_pose(project(points3D, VIEW, camera()), points3D, camera())
    second = rounds.send(pose)
    pixels = dict(zip(second.points.tolist(), second.pixels(query(PICTURE)).tolist(), strict=True))
    before = dict(zip(first.points.tolist(), first.pixels(query(PICTURE)).tolist(), strict=True))
    assert pixels.keys() == {1, 5, 7, 9}
    assert pixels[5] == pixels[9] != before[5]
    assert pixels[1] == before[1]


@pytest.mark.parametrize("step", [1, 2])
def test_the_object_is_located_by_photos_of_any_size(plain, step):
    nearer = pycolmap.Rigid3d(VIEW.rotation, 0.8 * VIEW.translation + (0.3, -0.2, 0))
    matcher = SphereMatcher([*poses(6), nearer], camera())
    photos = {name: matcher.photo(number)[::step, ::step] for number, name in enumerate(plain.images)}
    located = PhotoObjectFinder(replace(plain, photos=photos), matcher).find(matcher.photo(6))
    shown = box_region(BOX, nearer, camera())
    assert located.region is not None
    assert shown is not None
    np.testing.assert_allclose(located.region.corners, shown.corners, atol=25)
    assert located.references <= 6


def test_maps_of_keypoints_or_other_weights_and_missing_weights_are_errors(exact, plain, tmp_path):
    with pytest.raises(MapError, match="build a map with the extractor loftr"):
        strategy_of(exact)
    other = replace(plain, info=replace(plain.info, extractor_options={"weights": "loftr"}))
    with pytest.raises(MapError, match=r"needs a map built with the weights LoFTR_wsize9\.ckpt"):
        strategy_of(other)
    with (
        use_runtime(Runtime(weights=tmp_path)),
        pytest.raises(InputError, match=r"OnePosePlus_model\.ckpt"),
    ):
        strategy_of(plain)
