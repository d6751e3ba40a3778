"""Which model is taken: on exact scenes with wrong matches, it is right, in pieces or doubted."""

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from scenes import exact_map
from slimsfm.errors import InputError, ReconstructionError
from slimsfm.features import Features
from slimsfm.geometry import project
from slimsfm.mapping import sfm
from slimsfm.mapping.choice import CheckedModel, pick_model
from slimsfm.mapping.matching import verify_matches
from slimsfm.mapping.reconstruction import reconstruct
from slimsfm.mapping.scratch import write_database, write_geometries
from slimsfm.mapping.sfm import colmap_warnings
from slimsfm.synthetic.scene import look_at

SIZE, FOCAL = (640, 480), 560.0


@dataclass
class Photos:
    """Photos of points; points with one label look alike."""

    points: np.ndarray
    labels: np.ndarray
    cam_from_world: list[pycolmap.Rigid3d]
    normals: np.ndarray | None = None
    focal_lengths: dict[int, float] = field(default_factory=dict)
    prefix: str = "frame"

    @property
    def names(self) -> list[str]:
        return [f"{self.prefix}{number:02d}.png" for number in range(len(self.cam_from_world))]

    def camera(self, number: int) -> pycolmap.Camera:
        return _camera(self.focal_lengths.get(number, FOCAL))

    def seen(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels, with noise, and labels of the points that a photo shows."""
        pose = self.cam_from_world[number]
        pixels = project(self.points, pose, self.camera(number))
        visible = np.all((pixels > 0) & (pixels < SIZE), axis=1) & ((pose * self.points)[:, 2] > 0.1)
        if self.normals is not None:
            towards = pose.inverse().translation - self.points
            visible &= np.einsum("nd,nd->n", towards, self.normals) > 0
        noise = np.random.default_rng(number).normal(0, 0.3, pixels.shape)
        return (pixels + noise)[visible], self.labels[visible]


def _camera(focal_length: float) -> pycolmap.Camera:
    params = [focal_length, SIZE[0] / 2, SIZE[1] / 2, 0]
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=params, camera_id=1)


def mapped(folder: Path, *sets: Photos) -> list[CheckedModel]:
    """Reconstruct photos from their matches by labels, with one camera of a guessed focal length."""
    seen = {name: one.seen(number) for one in sets for number, name in enumerate(one.names)}
    features = {name: _features(pixels) for name, (pixels, _) in seen.items()}
    names, database = sorted(features), folder / "database.db"
    cameras = dict.fromkeys(names, _camera(1.2 * SIZE[0]))
    write_database(database, features, cameras)
    matches = {(a, b): _matched(seen[a][1], seen[b][1]) for a, b in combinations(names, 2)}
    with colmap_warnings():
        write_geometries(database, names, verify_matches(features, cameras, matches, seed=0))
        return reconstruct(database, names, folder / "sfm", seed=0)


def _matched(labels_a: np.ndarray, labels_b: np.ndarray) -> np.ndarray:
    return np.stack(np.intersect1d(labels_a, labels_b, return_indices=True)[1:], axis=1).astype(np.int64)


def _features(pixels: np.ndarray) -> Features:
    return Features(
        keypoints=pixels.astype(np.float32),
        descriptors=np.zeros((len(pixels), 1), np.float32),
        scores=np.ones(len(pixels), np.float32),
        image_size=SIZE,
    )


def around(count: int, *, radius: float = 3.0, turn: float = 2 * np.pi) -> list[pycolmap.Rigid3d]:
    """Cameras around the z axis that look at the origin."""
    angles = turn * np.arange(count) / count
    heights = 1 + 0.4 * np.sin(5 * angles)
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), heights], axis=1)
    return [look_at(place, np.zeros(3)) for place in places]


def cloud(seed: int, count: int, poses: list[pycolmap.Rigid3d], prefix: str, **others) -> Photos:
    """A cloud of points, all of which look different."""
    points = np.random.default_rng(seed).uniform(-0.7, 0.7, (count, 3))
    labels = 10_000 * seed + np.arange(count)
    return Photos(points=points, labels=labels, cam_from_world=poses, prefix=prefix, **others)


def can(count: int) -> Photos:
    """A can whose print repeats once around, on a floor with few points."""
    generator = np.random.default_rng(0)
    angles, heights = generator.uniform(0, np.pi, 150), generator.uniform(-0.5, 0.5, 150)
    half = np.stack([np.cos(angles), np.sin(angles), heights], axis=1) * (0.6, 0.6, 1)
    points = np.concatenate([half, half * (-1, -1, 1)])
    normals = points * (1, 1, 0)
    floor = np.concatenate([generator.uniform(-1.5, 1.5, (90, 2)), np.full((90, 1), -0.5)], axis=1)
    return Photos(
        points=np.concatenate([points, floor]),
        normals=np.concatenate([normals, np.tile((0.0, 0.0, 1.0), (90, 1))]),
        labels=np.concatenate([np.tile(np.arange(150), 2), 150 + np.arange(90)]),
        cam_from_world=around(count),
    )


def wrong(checked: CheckedModel, photos: Photos) -> int:
    """Number of photos whose rotation, relative to the best half of the model, is off by over 5 degrees."""
    images = {image.name: image for image in checked.model.images.values() if image.has_pose}
    pairs = [
        (pose.rotation, images[name].cam_from_world().rotation)
        for name, pose in zip(photos.names, photos.cam_from_world, strict=True)
        if name in images
    ]
    alignments = [(true.inverse() * found) for true, found in pairs]
    errors = [
        [np.degrees((true * one * found.inverse()).angle()) for true, found in pairs] for one in alignments
    ]
    return min(sum(error > 5 for error in row) for row in errors)


def test_a_right_model_is_taken_whole_and_nothing_contradicts_it(tmp_path):
    photos = cloud(1, 200, around(12, turn=np.pi), "frame")
    (only,) = mapped(tmp_path, photos)
    assert only.is_right
    assert only.way == ""
    assert only.quality.registered == only.quality.given == 12
    assert only.quality.verified_pairs == 66
    assert only.quality.contradicted_pairs == 0
    assert wrong(only, photos) == 0


def test_two_places_are_two_models_and_either_can_be_picked(tmp_path):
    first = cloud(1, 200, around(12, turn=np.pi), "first")
    second = cloud(2, 200, around(8, turn=np.pi), "second")
    models = mapped(tmp_path, first, second)
    assert [one.images for one in models] == [tuple(first.names), tuple(second.names)]
    picked = pick_model(models, 1)
    assert picked.model is models[0].model
    assert picked.elsewhere == set(second.names)
    (note,) = picked.notes
    assert "8 photos form another model, which `model=2` keeps" in note
    assert all(name in note for name in second.names)
    assert pick_model(models, 2).model is models[1].model
    with pytest.raises(InputError, match=r"model must be at most 2, got 3.*models of 12, 8 images"):
        pick_model(models, 3)


def test_look_alike_sides_are_told_apart(tmp_path):
    photos = can(24)
    models = mapped(tmp_path, photos)
    assert all(one.is_right for one in models)
    assert sum(one.quality.registered for one in models) >= 18
    assert [wrong(one, photos) for one in models] == [0] * len(models)
    assert "order of name" in models[0].way
    assert models[0].quality.contradicted_pairs > 0  # the pairs of look-alike sides


def test_photos_of_one_camera_that_are_zoomed_get_another_camera(tmp_path):
    zoomed = dict.fromkeys(range(0, 15, 3), 1.5 * FOCAL)
    photos = cloud(1, 300, around(15, turn=np.pi), "frame", focal_lengths=zoomed)
    (only,) = mapped(tmp_path, photos)
    assert only.is_right
    assert wrong(only, photos) == 0
    assert only.split == tuple(photos.names[number] for number in zoomed)
    found = sorted(camera.mean_focal_length() for camera in only.model.cameras.values())
    assert found == pytest.approx([FOCAL, 1.5 * FOCAL], rel=0.02)
    assert "5 photos have another focal length than others of their camera" in pick_model([only], 1).notes[0]


@pytest.mark.parametrize("turn", [0.35, 1.2])
def test_a_camera_that_only_turns_gives_no_model(tmp_path, turn):
    generator = np.random.default_rng(0)
    center = np.array([3.0, 0.0, 1.0])
    poses = [look_at(center, generator.uniform(-turn, turn, 3)) for _ in range(7)]
    with pytest.raises(ReconstructionError, match=r"turned but hardly moved|no three photos"):
        mapped(tmp_path, cloud(1, 120, poses, "frame"))


def test_an_image_that_hangs_on_the_rest_by_chance_is_left_out(tmp_path):
    photos = cloud(1, 200, around(12, turn=np.pi), "frame")
    stray = cloud(2, 200, around(1, turn=np.pi), "stray")
    stray.labels[:40] = photos.labels[:40]
    models = mapped(tmp_path, photos, stray)
    assert models[0].images == tuple(photos.names)
    assert models[0].is_right
    assert wrong(models[0], photos) == 0


def test_two_photos_of_nothing_in_common_are_named_as_such(tmp_path):
    one, other = cloud(1, 100, around(2, turn=0.3), "one"), cloud(2, 100, around(2, turn=0.3), "other")
    one.cam_from_world, other.cam_from_world = one.cam_from_world[:1], other.cam_from_world[:1]
    with pytest.raises(ReconstructionError, match="no three photos could be joined"):
        mapped(tmp_path, one, other)


def test_a_right_model_does_not_hide_a_contradicted_one(tmp_path):
    folded, other = can(24), cloud(3, 200, around(8, turn=np.pi), "other")
    folded.labels = 1000 + folded.labels
    models = mapped(tmp_path, folded, other)
    names = {name for one in models for name in one.images}
    assert set(other.names) <= names
    assert len(names & set(folded.names)) >= 18
    assert all(one.is_right for one in models)


@pytest.mark.parametrize("bad", [0, 2, 4])
def test_images_whose_camera_came_out_impossible_are_left_out(bad):
    model = exact_map(num_images=6).model
    for image_id in range(1, bad + 1):
        camera = pycolmap.Camera.create_from_model_name(1 + image_id, "SIMPLE_RADIAL", 500.0, 640, 480)
        camera.params = [500.0, 320.0, 240.0, -6.4]
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"bad{image_id}", camera_id=1 + image_id, image_id=100 + image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    sfm.drop_impossible(model)
    assert model.num_reg_images() == 6
    assert {model.image(i).camera_id for i in model.reg_image_ids()} == {1}
