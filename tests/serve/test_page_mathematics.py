"""The page's mathematics, against the library's and scipy's."""

import itertools

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation, Slerp

from javascript import needs_a_runtime, run
from slimsfm.geometry import project

LENSES = {
    "PINHOLE": [510.0, 505.0, 322.0, 237.0],
    "SIMPLE_RADIAL": [500.0, 318.0, 243.0, -0.12],
    "RADIAL": [500.0, 318.0, 243.0, -0.12, 0.03],
    "OPENCV": [500.0, 505.0, 322.0, 238.0, -0.08, 0.02, 0.001, -0.002],
}
DOWN_THE_CAMERA = {
    0: np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
    90: np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]]),
    180: np.array([[-1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    270: np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
}
"""Axes of the rear camera in the device's frame (x right, y up, z out of the screen), by the screen's angle:
90 for a phone that is turned counterclockwise; the picture is upright nevertheless."""


@pytest.fixture(autouse=True)
def runtime():
    needs_a_runtime()


def camera(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=640, height=480, params=LENSES[model])


def as_reply(one: pycolmap.Camera) -> dict:
    names = ("focal_length_x", "focal_length_y", "principal_point_x", "principal_point_y")
    intrinsics = dict(zip(("fx", "fy", "cx", "cy"), (getattr(one, name) for name in names), strict=True))
    return {"model": one.model_name, "width": 640, "height": 480, "params": one.params, **intrinsics}


def random_poses(count: int) -> list[pycolmap.Rigid3d]:
    turns = Rotation.random(count, rng=np.random.default_rng(0)).as_matrix()
    shifts = np.random.default_rng(1).uniform((-0.4, -0.4, 2), (0.4, 0.4, 4), (count, 3))
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(r), t) for r, t in zip(turns, shifts, strict=True)]


def as_json(pose: pycolmap.Rigid3d) -> dict:
    return {"quaternion_xyzw": pose.rotation.quat, "translation": pose.translation}


POINTS = np.random.default_rng(2).uniform(-0.8, 0.8, (40, 3))


@pytest.mark.parametrize("model", LENSES)
def test_points_project_as_in_the_library(model):
    poses = random_poses(5)
    found = run(
        """const { poseFrom, project, transform } = await load("pose.js");
        const { cameraFrom } = await load("cameras.js");
        const lens = cameraFrom(camera);
        return poses.map((pose) => points.map((p) => project(transform(poseFrom(pose), p), lens)));""",
        camera=as_reply(camera(model)),
        poses=[as_json(pose) for pose in poses],
        points=POINTS,
    )
    for pose, pixels in zip(poses, found, strict=True):
        np.testing.assert_allclose(pixels, project(POINTS, pose, camera(model)), atol=1e-8)


def test_the_matrices_of_webgl_project_as_in_the_library():
    poses, one = random_poses(5), camera("PINHOLE")
    found = run(
        """const { poseFrom } = await load("pose.js");
        const { cameraFrom } = await load("cameras.js");
        const { projectionMatrix, viewMatrix } = await load("matrices.js");
        const matrix = [...projectionMatrix(cameraFrom(camera), 0.5, 20)];
        return [matrix, poses.map((pose) => [...viewMatrix(poseFrom(pose))])];""",
        camera=as_reply(one),
        poses=[as_json(pose) for pose in poses],
    )
    projection = np.array(found[0]).reshape(4, 4).T
    for pose, columns in zip(poses, found[1], strict=True):
        view = np.array(columns).reshape(4, 4).T
        clip = (projection @ view @ np.column_stack([POINTS, np.ones(len(POINTS))]).T).T
        normal = clip[:, :3] / clip[:, 3:]
        pixels = (normal[:, :2] * (1, -1) + 1) / 2 * (640, 480)
        np.testing.assert_allclose(pixels, project(POINTS, pose, one), atol=1e-3)
        depth = (pose * POINTS)[:, 2]
        np.testing.assert_array_equal(np.argsort(normal[:, 2]), np.argsort(depth))
        assert np.all(np.abs(normal[(depth > 0.5) & (depth < 20), 2]) < 1)


def test_points_behind_the_camera_do_not_project():
    body = 'return (await load("pose.js")).project([0, 0, -1], { distortion: [0, 0, 0, 0] })'
    assert run(body) is None


def test_rotations_compose_as_in_the_library():
    a, b = (Rotation.random(8, rng=np.random.default_rng(seed)) for seed in (3, 4))
    found = run(
        """const m = await load("pose.js");
        return a.map((q, i) => ({
          product: m.multiply(q, b[i]), inverse: m.inverted(q), rotated: m.rotate(q, [1, 2, 3]),
          vector: m.toRotationVector(q), back: m.fromRotationVector(m.toRotationVector(q)),
          third: m.between(q, b[i], 0.3),
        }));""",
        a=a.as_quat(),
        b=b.as_quat(),
    )
    for i, one in enumerate(found):
        product = pycolmap.Rotation3d(a[i].as_quat()) * pycolmap.Rotation3d(b[i].as_quat())
        assert same(one["product"], product.quat)
        assert same(one["inverse"], a[i].inv().as_quat())
        assert same(one["back"], a[i].as_quat())
        assert same(one["third"], Slerp([0, 1], Rotation.concatenate([a[i], b[i]]))(0.3).as_quat())
        np.testing.assert_allclose(one["rotated"], a[i].apply([1, 2, 3]), atol=1e-12)
        np.testing.assert_allclose(one["vector"], a[i].as_rotvec(), atol=1e-12)


def same(a, b) -> bool:
    return bool(np.isclose(abs(np.dot(a, b)), 1, atol=1e-12))


def test_small_and_half_turns_have_rotation_vectors():
    turns = np.array([[0, 0, 0], [1e-12, 0, 0], [0, np.pi, 0], [0, 0, np.pi - 1e-9]])
    found = run(
        """const m = await load("pose.js");
        return turns.map((v) => m.toRotationVector(m.fromRotationVector(v)));""",
        turns=turns,
    )
    np.testing.assert_allclose(np.abs(found), turns, atol=1e-9)


def test_a_turn_of_the_camera_changes_its_pose_as_in_the_library():
    pose, turn = random_poses(1)[0], Rotation.from_rotvec([0.1, -0.2, 0.05])
    found = run(
        'const m = await load("pose.js"); return m.turned(turn, m.poseFrom(pose))',
        pose=as_json(pose),
        turn=turn.as_quat(),
    )
    expected = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), np.zeros(3)) * pose
    assert same(found["rotation"], expected.rotation.quat)
    np.testing.assert_allclose(found["translation"], expected.translation, atol=1e-12)


def camera_turn(earlier, later, angle) -> Rotation:
    return Rotation.from_quat(
        run(
            """const g = await load("gyroscope.js");
            return g.cameraTurn(g.earthFromDevice(...earlier), g.earthFromDevice(...later), angle);""",
            earlier=earlier,
            later=later,
            angle=angle,
        )
    )


@pytest.mark.parametrize("angle", DOWN_THE_CAMERA)
def test_turns_of_the_device_are_turns_of_its_camera(angle):
    earlier, later = (30.0, 80.0, -10.0), (34.0, 77.0, -5.0)
    device = [Rotation.from_euler("ZXY", angles, degrees=True).as_matrix() for angles in (earlier, later)]
    axes = DOWN_THE_CAMERA[angle]
    expected = axes @ device[1].T @ device[0] @ axes.T
    np.testing.assert_allclose(camera_turn(earlier, later, angle).as_matrix(), expected, atol=1e-12)


PORTRAIT, LANDSCAPE = (0.0, 90.0, 0.0), (0.0, 0.0, -90.0)
"""A phone held upright, and one turned counterclockwise, both with their back to the north."""


@pytest.mark.parametrize(("held", "angle"), [(PORTRAIT, 0), (LANDSCAPE, 90)], ids=["portrait", "landscape"])
def test_what_is_ahead_moves_left_when_a_phone_turns_right(held, angle):
    alpha, beta, gamma = held
    x, y, z = camera_turn(held, (alpha - 10, beta, gamma), angle).apply([0, 0, 1])
    assert x == pytest.approx(-np.sin(np.radians(10)))
    assert y == pytest.approx(0, abs=1e-12)
    assert z > 0


@pytest.mark.parametrize(
    ("held", "raised", "angle"),
    [(PORTRAIT, (0.0, 100.0, 0.0), 0), (LANDSCAPE, (180.0, 180.0, -80.0), 90)],
    ids=["portrait", "landscape"],
)
def test_what_is_ahead_moves_down_when_a_phone_tilts_up(held, raised, angle):
    x, y, _ = camera_turn(held, raised, angle).apply([0, 0, 1])
    assert y == pytest.approx(np.sin(np.radians(10)))
    assert x == pytest.approx(0, abs=1e-12)


def test_orientations_are_interpolated_and_missing_sensors_are_noticed():
    found = run(
        """const { Gyroscope } = await load("gyroscope.js");
        const [full, none] = [new Gyroscope(), new Gyroscope()];
        for (let i = 0; i <= 300; i++) full.add(10 * i, 0.5 * i, 90, 0);
        none.add(0, null, null, null);
        return {
          turn: full.turn(2905, 2953, 0), count: full.samples.length, runs: full.runs(3100),
          stale: full.runs(3300), later: full.turn(2990, 5000, 0),
          none: none.runs(0), idle: none.turn(0, 1, 0),
        };"""
    )
    assert Rotation.from_quat(found["turn"]).magnitude() == pytest.approx(np.radians(0.05 * 48), rel=1e-6)
    assert found["count"] <= 202
    assert (found["runs"], found["stale"], found["none"]) == (True, False, False)
    assert Rotation.from_quat(found["later"]).magnitude() == pytest.approx(np.radians(0.5), rel=1e-6)
    assert found["idle"] == [0, 0, 0, 1]


def one_euro(values, times, min_cutoff, beta, speed_cutoff):
    """The filter as its authors state it."""

    def share(cutoff, seconds):
        return 1 / (1 + 1 / (2 * np.pi * cutoff * seconds))

    filtered, speed = [values[0]], np.zeros_like(values[0])
    for value, (before, now) in zip(values[1:], itertools.pairwise(times), strict=True):
        seconds = now - before
        rate = (value - filtered[-1]) / seconds
        speed = speed + share(speed_cutoff, seconds) * (rate - speed)
        cutoff = min_cutoff + beta * np.linalg.norm(speed)
        filtered.append(filtered[-1] + share(cutoff, seconds) * (value - filtered[-1]))
    return np.array(filtered)


def test_the_filter_is_the_one_euro_filter():
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.02, 0.1, 60))
    values = np.sin(times)[:, None] * (1.0, 0.5) + 0.05 * rng.normal(size=(60, 2))
    found = run(
        """const { OneEuro } = await load("smoothing.js");
        const filter = new OneEuro({ minCutoff: 1.2, beta: 0.7, speedCutoff: 0.9 });
        let last = values[0];
        return values.map((value, i) => {
          if (i === 0) return last;
          const residual = value.map((x, k) => x - last[k]);
          const share = filter.follow(residual, times[i] - times[i - 1]);
          return (last = last.map((x, k) => x + share * residual[k]));
        });""",
        values=values,
        times=times,
    )
    np.testing.assert_allclose(found, one_euro(values, times, 1.2, 0.7, 0.9), atol=1e-12)


def smoothed(poses, turns=None) -> list[pycolmap.Rigid3d]:
    """The poses, one per 50 ms, after the page's filter; the object is at the origin."""
    found = run(
        """const { PoseFilter } = await load("smoothing.js");
        const { NO_TURN, poseFrom } = await load("pose.js");
        const filter = new PoseFilter([0, 0, 0]);
        const turn = (i) => (turns ? turns[i] : NO_TURN);
        return poses.map((pose, i) => filter.smooth(0.05 * i, poseFrom(pose), turn(i)));""",
        poses=[as_json(pose) for pose in poses],
        turns=None if turns is None else [turn.as_quat() for turn in turns],
    )
    return [
        pycolmap.Rigid3d(pycolmap.Rotation3d(one["rotation"]), np.array(one["translation"])) for one in found
    ]


def turned_by(vector) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(vector, float)), np.zeros(3))


AHEAD = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, 2.0]))


def angles_to(poses, truth) -> np.ndarray:
    return np.array([(a.rotation.inverse() * b.rotation).angle() for a, b in zip(poses, truth, strict=True)])


def test_noise_of_a_still_camera_is_smoothed():
    rng = np.random.default_rng(6)
    noisy = [turned_by(0.002 * rng.normal(size=3)) * AHEAD for _ in range(200)]
    still = [AHEAD] * 200
    assert angles_to(smoothed(noisy), still)[20:].mean() < 0.65 * angles_to(noisy, still)[20:].mean()


def test_a_moving_camera_is_followed_at_once():
    walk = [turned_by([0, 0.025 * i, 0]) * AHEAD for i in range(60)]  # 29 degrees per second
    assert (
        angles_to(smoothed(walk), walk)[10:].max() < 0.25 * 0.025
    )  # a quarter of the way between two frames


def test_with_the_gyroscope_there_is_no_lag():
    walk = [turned_by([0, 0.025 * i, 0]) * AHEAD for i in range(60)]
    turns = [Rotation.from_rotvec([0, 0.025, 0])] * 60
    assert angles_to(smoothed(walk, turns), walk).max() < 1e-9


@pytest.mark.parametrize(
    "jump", [turned_by([0, 0.3, 0]), pycolmap.Rigid3d(pycolmap.Rotation3d(), np.ones(3))]
)
def test_a_jump_is_not_smoothed(jump):
    poses = [AHEAD] * 5 + [jump * AHEAD] * 2
    after = smoothed(poses)[5]
    np.testing.assert_allclose(after.matrix(), poses[5].matrix(), atol=1e-12)
