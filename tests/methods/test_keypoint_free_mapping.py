from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares

from detector_free import RADIUS, SphereMatcher, ring_of_cameras
from scenes import camera
from slimsfm.cli.output import quiet
from slimsfm.errors import InputError
from slimsfm.geometry import reprojection_errors
from slimsfm.mapping.pairs import exhaustive_pairs
from slimsfm.mapping.workspace import Workspace
from slimsfm.methods.loftr.cells import EncodedImage, ImageMatcher, in_tiles, match_without_keypoints
from slimsfm.methods.loftr.extractor import choose_image_pairs, neighboring_pairs
from slimsfm.methods.loftr.mapping import KeypointFreeModel, build_without_keypoints
from slimsfm.methods.loftr.rays import choose_references, rays_of, read_tracks, refine_depths

POSES = ring_of_cameras(6)
NAMES = [f"{number}.png" for number in range(len(POSES))]
CELL_PX = 16.0  # the matcher sees images half as large


def one_camera():
    made = camera()
    made.camera_id = 1
    return made


@dataclass(frozen=True)
class Sphere:
    matcher: SphereMatcher
    photos: dict

    def build(self, workspace, **options) -> KeypointFreeModel:
        cameras = dict.fromkeys(self.photos, one_camera())
        poses = dict(zip(NAMES, POSES, strict=True))
        with quiet():
            return build_without_keypoints(
                self.photos,
                exhaustive_pairs(self.photos),
                self.matcher,
                cameras,
                Workspace(workspace, {}),
                cam_from_world=poses,
                **options,
            )


def sphere(reach_px=np.inf):
    matcher = SphereMatcher(POSES, one_camera(), CELL_PX, reach_px)
    return Sphere(matcher, {name: matcher.photo(number) for number, name in enumerate(NAMES)})


@pytest.fixture(scope="module")
def scene():
    return sphere()


@pytest.fixture(scope="module")
def built(scene, tmp_path_factory):
    return scene.build(tmp_path_factory.mktemp("sphere"))


def errors_px(model):
    """Of every observation."""
    found = []
    for image in model.images.values():
        rows = np.array(image.get_observation_point2D_idxs())
        pixels = np.array([image.points2D[row].xy for row in rows])
        points = np.array([model.point3D(image.points2D[row].point3D_id).xyz for row in rows])
        found.append(
            reprojection_errors(pixels, points, image.cam_from_world(), model.camera(image.camera_id))
        )
    return np.concatenate(found)


def test_the_matcher_of_the_tests_is_one(scene):
    assert isinstance(scene.matcher, ImageMatcher)
    assert isinstance(scene.matcher.encode(scene.photos[NAMES[0]]), EncodedImage)


def test_keypoints_are_the_matched_cells_each_once_the_surest_first(scene, tmp_path):
    pairs = exhaustive_pairs(NAMES)
    cells = match_without_keypoints(scene.photos, pairs, scene.matcher, Workspace(tmp_path, {}))
    encoded = {name: scene.matcher.encode(scene.photos[name]) for name in NAMES}
    for name, features in cells.features.items():
        assert len(np.unique(features.keypoints, axis=0)) == len(features) > 50
        assert np.array_equal(features.keypoints, encoded[name].cell_of(features.keypoints))
        assert np.all(np.diff(features.scores) <= 0)
        assert cells.cell_px[name] == CELL_PX
    for a, b in pairs:
        matches = scene.matcher.match_cells(encoded[a], encoded[b])
        rows1, rows2 = cells.matches.get((a, b), np.zeros((0, 2), np.int64)).T
        found = np.column_stack([cells.features[a].keypoints[rows1], cells.features[b].keypoints[rows2]])
        given = np.column_stack([matches.points2D_1, matches.points2D_2])
        assert np.array_equal(np.unique(found, axis=0), np.unique(given, axis=0))


def test_masked_cells_do_not_match(scene, tmp_path):
    mask = np.zeros((480, 640), np.uint8)
    mask[:, 320:] = 255
    pairs, masks = exhaustive_pairs(NAMES), {NAMES[2]: mask}
    cells = match_without_keypoints(scene.photos, pairs, scene.matcher, Workspace(tmp_path, {}), masks)
    assert cells.features[NAMES[2]].keypoints[:, 0].min() > 320
    assert cells.features[NAMES[1]].keypoints[:, 0].min() < 320


def test_refinement_makes_points_and_keypoints_exact(built):
    points = np.array([point.xyz for point in built.model.points3D.values()])
    assert len(points) > 80
    assert np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() < 1e-9
    assert errors_px(built.model).max() < 1e-6
    assert built.model.is_valid()
    for image in built.model.images.values():
        assert image.num_points3D == image.num_points2D() == len(built.features[image.name])
        keypoints = np.array([point.xy for point in image.points2D], np.float32)
        assert np.array_equal(keypoints, built.features[image.name].keypoints)


def test_known_poses_and_cameras_stay_as_they_are(built):
    for image in built.model.images.values():
        assert np.array_equal(image.cam_from_world().matrix(), POSES[NAMES.index(image.name)].matrix())
    found, given = built.model.cameras[1], one_camera()
    assert np.array_equal(found.params, given.params)
    assert (found.width, found.height) == (given.width, given.height)


def test_features_tell_what_a_keypoint_shows(built):
    """The matcher of the tests describes a pixel by its position on the sphere."""
    for image in built.model.images.values():
        points = np.array([built.model.point3D(point.point3D_id).xyz for point in image.points2D])
        descriptors = built.features[image.name].descriptors
        assert descriptors.dtype == np.float16
        assert np.abs(descriptors - points).max() < 1e-3


def test_matches_are_between_keypoints_that_are_left(built):
    assert len(built.matches) > 5
    images = {image.name: image for image in built.model.images.values()}
    same = total = 0
    for (a, b), pairs in built.matches.items():
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) > 0
        points_a, points_b = (
            np.array([images[name].points2D[row].point3D_id for row in pairs[:, side].tolist()])
            for side, name in enumerate((a, b))
        )
        same, total = same + int((points_a == points_b).sum()), total + len(pairs)
    assert same > 0.7 * total


def test_what_cannot_be_aligned_is_dropped_if_it_is_too_far_off(tmp_path, built):
    short_sighted = sphere(reach_px=5.0).build(tmp_path)
    errors = errors_px(short_sighted.model)
    assert 1 < errors.max() <= 0.5 * CELL_PX
    assert short_sighted.model.compute_num_observations() < built.model.compute_num_observations()


def test_building_twice_gives_the_same(scene, built, tmp_path):
    again = scene.build(tmp_path)
    for name, features in built.features.items():
        assert np.array_equal(features.keypoints, again.features[name].keypoints)
        assert np.array_equal(features.descriptors, again.features[name].descriptors)
    assert [(i, *p.xyz) for i, p in sorted(built.model.points3D.items())] == [
        (i, *p.xyz) for i, p in sorted(again.model.points3D.items())
    ]


def test_references_are_one_a_point_and_in_few_images(built):
    tracks = read_tracks(built.model)
    is_reference = choose_references(tracks)
    assert np.array_equal(tracks.points[is_reference], np.arange(len(tracks.point3D_ids)))
    counts = np.bincount(tracks.images, minlength=len(NAMES))
    assert np.bincount(tracks.images[is_reference]).max() == counts.max()


def test_depths_are_those_of_least_squares(built):
    """On noisy observations, point by point, as scipy finds them."""
    tracks = read_tracks(built.model)
    rng = np.random.default_rng(0)
    tracks = replace(tracks, points2D=tracks.points2D + rng.normal(scale=1.0, size=tracks.points2D.shape))
    rays = rays_of(built.model, tracks, choose_references(tracks))
    start = rays.depths * rng.uniform(0.9, 1.1, len(rays.depths))
    depths = refine_depths(rays.observations, start)
    for point in range(20):
        mine = rays.observations[np.flatnonzero(rays.observations.points == point)]
        mine = replace(mine, points=np.zeros(len(mine.points), np.int64))
        found = least_squares(
            lambda depth, mine=mine: mine.residuals(depth).ravel(), start[point : point + 1], xtol=1e-14
        )
        assert depths[point] == pytest.approx(found.x[0], rel=1e-6)
        assert np.sum(mine.residuals(depths[point : point + 1]) ** 2) <= 2 * found.cost * (1 + 1e-9)


def test_a_point_that_nothing_fixes_stays(built):
    tracks = read_tracks(built.model)
    rays = rays_of(built.model, tracks, choose_references(tracks))
    nothing = rays.observations[np.zeros(0, np.int64)]
    assert np.array_equal(refine_depths(nothing, rays.depths), rays.depths)


def test_pairs_in_tiles_are_the_same_pairs_and_reread_few_images():
    pairs = exhaustive_pairs(f"{number:02d}" for number in range(40))
    tiled = in_tiles(pairs, 5)
    assert sorted(tiled) == pairs
    for start in range(0, len(tiled), 25):
        assert len({name for pair in tiled[start : start + 25] for name in pair}) <= 20


def test_neighbours_are_near_and_look_elsewhere():
    ring = {f"{i:02d}": pose for i, pose in enumerate(ring_of_cameras(12))}
    assert neighboring_pairs(ring) == neighboring_pairs(dict(reversed(ring.items())))
    twins = {**ring, "00 again": ring["00"]}
    assert ("00", "00 again") not in neighboring_pairs(twins)
    many = {
        f"{i:03d}": pycolmap.Rigid3d(pose.rotation, pose.translation)
        for i, pose in enumerate(ring_of_cameras(12) * 4)
    }
    assert len(neighboring_pairs(many)) < len(exhaustive_pairs(many)) / 2


def test_pairs_of_similar_images_cannot_be_asked_for():
    names = [f"{number:02d}" for number in range(40)]
    with pytest.raises(InputError, match="`pairs='exhaustive'`"):
        choose_image_pairs(names, "similar", None)
    assert choose_image_pairs(names[:30], "auto", None) == exhaustive_pairs(names[:30])
    assert len(choose_image_pairs(names, "auto", None)) < len(exhaustive_pairs(names))


def test_it_runs_with_a_network(tmp_path):
    """With seeded weights and a plane of random squares, on which cells are exact."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("kornia")
    from networks.seeded import fill
    from slimsfm.methods.loftr.matcher import Loftr
    from slimsfm.methods.loftr.network import make_network

    network = make_network(window=9, coarse_context=False).eval()
    fill(network, 0)
    with torch.no_grad():
        network.backbone.layer3_outconv.weight.mul_(2)  # else confidences are flat
    matcher = Loftr(weights="loftr-onepose++", threshold=0.01)
    matcher.__dict__["network"] = network
    squares = np.random.default_rng(2).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    plane = np.kron(squares, np.ones((4, 4, 1), np.uint8))
    shifts = {"a": (0, 0), "b": (16, 8), "c": (32, 16)}
    photos = {name: plane[y : y + 128, x : x + 200] for name, (x, y) in shifts.items()}
    made = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 200.0, 200, 128)
    poses = {
        name: pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x / 200, -y / 200, 1]))
        for name, (x, y) in shifts.items()
    }
    cameras = dict.fromkeys(photos, made)
    with quiet():
        found = build_without_keypoints(
            photos, exhaustive_pairs(photos), matcher, cameras, Workspace(tmp_path, {}), cam_from_world=poses
        )
    assert len(found.model.points3D) > 10
    for name, features in found.features.items():
        assert features.descriptors.shape == (len(features), 384), name
        assert features.descriptors.dtype == np.float16
        assert np.isfinite(features.descriptors).all()
