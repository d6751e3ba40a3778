from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from detector_free import RADIUS, SphereMatcher, ring_of_cameras
from scenes import camera
from slimsfm.cli.output import quiet
from slimsfm.errors import InputError
from slimsfm.features.registry import EXTRACTORS, ExtractorEntry
from slimsfm.geometry import Box, corner_error, reprojection_errors
from slimsfm.localization.localizer import Localizer
from slimsfm.localization.matching import ReferenceMatching
from slimsfm.localization.strategy import Query, unite
from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import exhaustive_pairs
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.workspace import Workspace
from slimsfm.methods.loftr.extractor import DetectorFree, DetectorFreeMatching
from slimsfm.methods.loftr.mapping import build_without_keypoints
from slimsfm.pose import estimate_pose
from slimsfm.synthetic.scene import look_at
from slimsfm.weights import FOLDER

POSES = [*ring_of_cameras(5), look_at(np.array([3.5, 2.5, 0.9]), np.zeros(3))]  # the last is the query's
NAMES = [f"{number}.png" for number in range(5)]
BOX = Box(np.zeros(3), RADIUS * np.eye(3))


def matcher():
    return SphereMatcher(POSES, camera(), 16.0)


@pytest.fixture(scope="module")
def sphere(tmp_path_factory) -> Map:
    """A map whose photos are half as large as the images were."""
    made = camera()
    made.camera_id = 1
    photos = {name: matcher().photo(number) for number, name in enumerate(NAMES)}
    with quiet():
        built = build_without_keypoints(
            photos,
            exhaustive_pairs(NAMES),
            matcher(),
            dict.fromkeys(NAMES, made),
            Workspace(tmp_path_factory.mktemp("sphere"), {}),
            cam_from_world=dict(zip(NAMES, POSES, strict=False)),
        )
    info = MapInfo(extractor="loftr", box=BOX, box_source="given", origin="made by the tests")
    small = {name: photo[::2, ::2] for name, photo in photos.items()}
    return Map(model=built.model, features=built.features, matches=built.matches, photos=small, info=info)


class SphereExtractor(DetectorFree):
    """Matches by the matcher that knows the sphere."""

    @property
    def matcher(self) -> SphereMatcher:
        return matcher()


def query(step=1):
    image = np.ascontiguousarray(matcher().photo(5)[::step, ::step])
    features = DetectorFree().extract(image)
    return Query(
        keypoints=np.zeros((0, 2)),
        descriptors=np.zeros((0, 0), np.float32),
        features=features,
        camera=camera(),
        image=image,
    )


def test_it_matches_references_as_others_do(sphere):
    matching = DetectorFreeMatching(sphere, matcher)
    assert isinstance(matching, ReferenceMatching)
    descriptors, points = matching.target(2)
    assert np.array_equal(points, sphere.observations[NAMES[2]].points)
    assert descriptors.shape == (len(points), 3)


@pytest.mark.parametrize("step", [1, 2])
def test_matches_are_where_the_points_are_seen(sphere, step):
    """Whether photo and query are as large as their cameras say or half as large."""
    matching = DetectorFreeMatching(sphere, matcher)
    found = matching.match([(query(step), 1)], None)[0]
    assert len(found) > 20
    assert len(np.unique(found.points)) == len(found)
    points3D = sphere.points3D_in_world[found.points]
    errors = reprojection_errors(found.pixels(query()), points3D, POSES[5], camera())
    assert errors.max() < 1e-3  # the keypoints of features are in single precision


def test_an_exact_scene_localizes(sphere):
    matching = DetectorFreeMatching(sphere, matcher)
    found = unite(matching.match([(query(), row) for row in range(len(NAMES))], None))
    assert found.references == len(NAMES)
    pose = estimate_pose(found.pixels(query()), sphere.points3D_in_world[found.points], camera())
    assert pose is not None
    assert corner_error(pose.cam_from_world, POSES[5], BOX) < 1e-5


def test_a_map_of_fewer_images_localizes_too(sphere):
    slim = keep_images(sphere, NAMES[1:3])
    matching = DetectorFreeMatching(slim, matcher)
    found = unite(matching.match([(query(), row) for row in range(2)], None))
    pose = estimate_pose(found.pixels(query()), slim.points3D_in_world[found.points], camera())
    assert pose is not None
    assert corner_error(pose.cam_from_world, POSES[5], BOX) < 1e-5


def test_a_view_of_nothing_in_common_gives_no_match(sphere):
    behind = SphereMatcher([*POSES[:5], look_at(np.array([-5.0, -3, 0]), np.zeros(3))], camera(), 16.0)
    found = DetectorFreeMatching(sphere, lambda: behind).match([(query(), 1)], None)[0]
    assert len(found) == 0
    assert found.pixels(query()).shape == (0, 2)


def test_a_query_is_described_per_cell(sphere):
    """The matcher of the tests describes a pixel by its position on the sphere."""
    described = DetectorFreeMatching(sphere, matcher).describe(query())
    assert described.shape == (40 * 30, 3)
    seen = described[described.any(axis=1)]
    towards = POSES[5].inverse().translation
    assert np.all(seen @ towards > 0)
    assert len(seen) > 100


def test_missing_photos_and_images_are_errors(sphere):
    with pytest.raises(InputError, match="with the extractor loftr"):
        DetectorFreeMatching(replace(sphere, photos={}), matcher)
    with pytest.raises(InputError, match="image"):
        DetectorFreeMatching(sphere, matcher).match([(replace(query(), image=None), 0)], None)


@pytest.fixture
def folder(tmp_path):
    """Photos of the sphere on disk."""
    (tmp_path / "photos").mkdir()
    for number, name in enumerate(NAMES):
        Image.fromarray(matcher().photo(number)).save(tmp_path / "photos" / name)
    return tmp_path / "photos"


def test_from_photos_by_way_of_the_disk_to_a_pose(folder, tmp_path, monkeypatch):
    entry = ExtractorEntry(path="methods.test_reference_matching:SphereExtractor", has_keypoints=False)
    monkeypatch.setitem(EXTRACTORS, "loftr", entry)
    monkeypatch.delenv(FOLDER, raising=False)
    made = camera()
    made.camera_id = 1
    known = KnownPoses(
        cameras=dict.fromkeys(NAMES, made),
        cam_from_world=dict(zip(NAMES, POSES, strict=False)),
        box=BOX,
        unit="metre",
    )
    options = BuildOptions(extractor="loftr", max_image_size=320)
    with quiet():
        write_map(build_map(folder, options, known=known), tmp_path / "map")
    map_ = read_map(tmp_path / "map")
    assert map_.info.extractor_options == {"max_image_size": 320, "weights": "loftr"}
    assert map_.photos[NAMES[0]].shape == (240, 320, 3)
    found = Localizer(map_).localize(matcher().photo(5), camera())
    assert found.pose is not None
    assert corner_error(found.pose.cam_from_world, POSES[5], BOX) < 1e-5
