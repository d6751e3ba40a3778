from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from networks.seeded import fill  # noqa: E402
from scenes import BOX, camera, exact_map, poses  # noqa: E402
from slimsfm.errors import InputError, MapError  # noqa: E402
from slimsfm.features import Features, unit_rows  # noqa: E402
from slimsfm.geometry import corner_error, project  # noqa: E402
from slimsfm.localization.cameras import QueryCamera  # noqa: E402
from slimsfm.localization.rounds import given_features  # noqa: E402
from slimsfm.localization.search import Search  # noqa: E402
from slimsfm.localization.strategies import Direct  # noqa: E402
from slimsfm.localization.strategy import MatchingOptions, PoseGuided, Query, Strategy  # noqa: E402
from slimsfm.mapping.map import Map  # noqa: E402
from slimsfm.mapping.subset import keep_images  # noqa: E402
from slimsfm.methods.onepose.crop import box_region  # noqa: E402
from slimsfm.methods.onepose.network import GraphAttentionMatcher  # noqa: E402
from slimsfm.methods.onepose.strategy import ObjectFinder, OnePoseStrategy, object_views  # noqa: E402
from slimsfm.pose import RansacOptions, estimate_pose  # noqa: E402
from slimsfm.synthetic.scene import look_at  # noqa: E402
from slimsfm.weights import Runtime, use_runtime  # noqa: E402

POINTS = 40
VIEW = poses(17)[5]
SIDES = [box_region(BOX, pose, camera()).side for pose in poses(6)]
AS_LARGE = (
    round(np.median(SIDES)),
    round(np.median(SIDES)),
    3,
)  # as large as in the references
AWAY = look_at(np.array([5.0, 0, 0]), np.array([10.0, 0, 0]))


class DotExtractor:
    """Finds the dots of `picture`, each with the descriptor of its point."""

    name, options = "superpoint", {}

    def __init__(self, descriptors: np.ndarray) -> None:
        self._descriptors = descriptors
        self.seen: list[tuple] = []

    def extract(self, image, mask=None) -> Features:  # noqa: ARG002
        self.seen.append(image.shape)
        rows, columns = np.nonzero(image[:, :, 2] >= 250)
        shown = np.round((image[rows, columns, 0] - 10.0) / 5).astype(np.int64)
        counts = np.bincount(shown, minlength=POINTS)
        found = np.flatnonzero(counts)
        sums = [np.bincount(shown, side + 0.5, POINTS)[found] for side in (columns, rows)]
        return Features(
            keypoints=(np.stack(sums, axis=1) / counts[found, None]).astype(np.float32),
            descriptors=self._descriptors[found],
            scores=np.ones(len(found), np.float32),
            image_size=image.shape[1::-1],
        )


def picture(map_: Map) -> np.ndarray:
    """The points as dots of five pixels, each of its own color."""
    image = np.zeros((480, 640, 3), np.uint8)
    for point, (x, y) in enumerate(project(map_.points3D_in_world, VIEW, camera()).astype(int)):
        image[y - 2 : y + 3, x - 2 : x + 3] = 10 + 5 * point, 245 - 5 * point, 255
    return image


@pytest.fixture(scope="module")
def scene() -> Map:
    """An exact scene with descriptors as long as SuperPoint's."""
    made = exact_map(num_points=POINTS)
    longer, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(256, 32)))
    features = {
        name: replace(one, descriptors=(one.descriptors @ longer.T).astype(np.float16))
        for name, one in made.features.items()
    }
    return replace(made, features=features, info=replace(made.info, extractor="superpoint"))


@pytest.fixture
def extractor(scene) -> DotExtractor:
    name, seen = next(iter(scene.observations.items()))
    descriptors = scene.features[name].descriptors[seen.rows[np.argsort(seen.points)]]
    return DotExtractor(descriptors)


@pytest.fixture
def make(extractor):
    """Creates the strategy with the extractor of dots."""
    return partial(OnePoseStrategy, extractor=extractor)


def write(folder: Path, network: GraphAttentionMatcher) -> Path:
    state = {f"matcher.{key}": value for key, value in network.state_dict().items()}
    torch.save({"state_dict": state}, folder / "GATsSPG.ckpt")
    return folder


@pytest.fixture(scope="module")
def made_up(tmp_path_factory) -> Path:
    network = GraphAttentionMatcher()
    fill(network, 0)
    return write(tmp_path_factory.mktemp("made-up"), network)


@pytest.fixture(scope="module")
def by_likeness(tmp_path_factory) -> Path:
    """Weights with which almost only the similarity of descriptors counts."""
    network = GraphAttentionMatcher().requires_grad_(False)
    for key, value in network.state_dict().items():
        if ".mlp.3." in key:
            value.zero_()
        elif key.endswith(".W"):
            value[:, 0] = -1.0  # real observations are preferred to filled-up ones
        elif key.endswith(".a"):
            value[0] = 1.0
    network.final_proj.weight[:, :, 0] = torch.eye(256)
    network.final_proj.bias.zero_()
    return write(tmp_path_factory.mktemp("by-likeness"), network)


@pytest.fixture(autouse=True)
def weights(by_likeness):
    with use_runtime(Runtime(weights=by_likeness, device="cpu")):
        yield


def query(scene: Map, extractor: DotExtractor) -> Query:
    image = picture(scene)
    features = extractor.extract(image)
    extractor.seen.clear()
    return Query(
        keypoints=features.keypoints.astype(np.float64),
        descriptors=unit_rows(features.descriptors),
        features=features,
        camera=camera(),
        image=image,
    )


def strongest(of: Query, count: int) -> Query:
    rows = np.arange(count)
    return replace(
        of, keypoints=of.keypoints[rows], descriptors=of.descriptors[rows], features=of.features[rows]
    )


def all_rounds(strategy: OnePoseStrategy, of: Query, map_: Map) -> list:
    rounds, pose, found = strategy.rounds(of), None, []
    while True:
        try:
            found.append(rounds.send(pose))
        except StopIteration:
            return found
        pose = estimate_pose(found[-1].pixels(of), map_.points3D_in_world[found[-1].points], camera())


def errors(matches, of: Query, map_: Map) -> np.ndarray:
    right = project(map_.points3D_in_world[matches.points], VIEW, camera())
    return np.linalg.norm(matches.pixels(of) - right, axis=1)


def test_the_scene_is_localized(make, scene, extractor):
    strategy = make(scene)
    believed = QueryCamera(camera=camera(), source="given")
    of = query(scene, extractor)
    search = Search(scene, strategy, RansacOptions())
    found = search.run(given_features(of.features, 1.0), lambda _: of, believed).best
    assert corner_error(found.pose.cam_from_world, VIEW, BOX) < 0.01
    assert found.pose.num_inliers > 0.8 * POINTS
    assert found.confidence > 0.9


def test_it_looks_closely_where_images_locate_the_object_then_where_the_pose_does(make, scene, extractor):
    of = query(scene, extractor)
    one, other = all_rounds(make(scene), of, scene)
    assert extractor.seen == [AS_LARGE] * 2
    assert 0 < one.references == other.references <= len(scene.images)
    for matches in (one, other):
        assert np.median(errors(matches, of, scene)) < 0.5
    assert len(other) >= len(one) > 0.8 * POINTS


def test_without_an_image_only_its_features_are_used(make, scene, extractor):
    of = replace(query(scene, extractor), image=None)
    (found,) = all_rounds(make(scene), of, scene)
    assert not extractor.seen
    assert np.isin(found.pixels(of), of.keypoints).all()
    assert len(found) > 0.8 * POINTS


def test_with_any_weights_equal_queries_get_equal_matches(make, scene, extractor, made_up):
    with use_runtime(Runtime(weights=made_up, device="cpu")):
        one, two = make(scene, threshold=0.0), make(scene, threshold=0.0)
    assert isinstance(one, Strategy)
    assert isinstance(one, PoseGuided)
    of = query(scene, extractor)
    for a, b in zip(all_rounds(one, of, scene), all_rounds(two, of, scene), strict=True):
        assert len(a) == len(np.unique(a.points)) > 5
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.pixels(of), b.pixels(of))


def test_each_round_keeps_the_points_of_earlier_rounds(make, scene, extractor):
    of = query(scene, extractor)
    for before, matches in pairwise(all_rounds(make(scene), of, scene)):
        assert np.isin(before.points, matches.points).all()
        assert len(np.unique(matches.points)) == len(matches)


def test_the_whole_image_is_used_if_the_region_gives_no_pose(make, scene, extractor):
    of = query(scene, extractor)
    rounds = make(scene).rounds(of)
    next(rounds)
    found = rounds.send(None)
    assert extractor.seen == [AS_LARGE]
    assert np.isin(found.pixels(of), of.keypoints).all()


def test_near_a_pose_it_looks_where_the_pose_projects_the_box(make, scene, extractor):
    strategy, of = make(scene), query(scene, extractor)
    found = strategy.near(of, poses(18)[5])
    assert extractor.seen == [AS_LARGE]
    assert np.median(errors(found, of, scene)) < 0.5
    assert len(found) > 0.5 * POINTS
    assert len(strategy.near(of, AWAY)) > 0.8 * POINTS
    assert extractor.seen == [AS_LARGE]


def test_the_finder_finds_the_box(scene, extractor):
    finder = ObjectFinder(scene, MatchingOptions(), object_views(scene))
    right = box_region(BOX, VIEW, camera())
    found = finder.find(query(scene, extractor)).region
    assert found.corners == pytest.approx(right.corners, abs=0.25 * right.side)
    nowhere = finder.find(strongest(query(scene, extractor), 0))
    assert nowhere.region is None
    assert nowhere.references == len(scene.images)


def test_a_query_of_one_keypoint_or_none_has_no_matches(make, scene, extractor):
    of = query(scene, extractor)
    for count in (0, 1):
        few = replace(strongest(of, count), image=None)
        assert [len(found) for found in all_rounds(make(scene), few, scene)] == [0]


def test_a_map_of_one_image_is_enough(make, scene, extractor):
    alone = keep_images(scene, [next(iter(scene.images))])
    assert len(all_rounds(make(alone), query(scene, extractor), alone)[-1]) > 0.5 * POINTS


def test_visible_points_are_those_of_direct_matching(make, scene):
    for a, b in zip(make(scene).visible_points(VIEW), Direct(scene).visible_points(VIEW), strict=True):
        assert np.array_equal(a, b)


def test_features_of_another_kind_are_refused(make, exact):
    with pytest.raises(MapError, match="with the extractor superpoint"):
        make(exact)


def test_missing_weights_are_named(make, scene, tmp_path):
    with use_runtime(Runtime(weights=tmp_path)), pytest.raises(InputError, match=r"GATsSPG\.ckpt"):
        make(scene)
