"""The similarity between positions: exact, robust, and honest about what is not determined."""

import numpy as np
import pycolmap
import pytest
from test_transform import similarity

from slimsfm.errors import InputError
from slimsfm.upkeep.similarity import check_determined, fit_similarity
from slimsfm.upkeep.stretch import check_not_stretched, stretch_between

AXES = ("east-west", "north-south", "up")


def ring(count: int = 30, radius: float = 1.0) -> np.ndarray:
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(3 * angles)], axis=1)


def test_exact_positions_give_the_similarity():
    truth = similarity(0)
    found = fit_similarity(ring(), truth * ring())
    np.testing.assert_allclose(found.target_from_source.matrix(), truth.matrix(), atol=1e-9)
    assert found.is_inlier.all()
    check_determined(found, ring(), "positions")


def test_up_to_two_fifths_may_be_wrong():
    truth, rng = similarity(1), np.random.default_rng(1)
    target = truth * ring()
    target[:12] += rng.normal(size=(12, 3)) * 10
    found = fit_similarity(ring(), target)
    np.testing.assert_allclose(found.target_from_source.matrix(), truth.matrix(), atol=1e-9)
    assert not found.is_inlier[:12].any()
    assert found.is_inlier[12:].all()


def test_bounds_hold():
    rng = np.random.default_rng(2)
    source = ring(30, 20.0)
    held = []
    for _ in range(30):
        found = fit_similarity(source, source + rng.normal(size=source.shape) * 2)
        *_, z, w = found.target_from_source.rotation.quat
        heading = abs(np.degrees(2 * np.arctan2(z, abs(w))))
        scale = abs(found.target_from_source.scale - 1)
        held.append([heading < found.heading_bound_deg, scale < found.scale_bound])
    assert np.mean(held) > 0.88


def test_the_same_positions_give_the_same_bytes():
    target = ring(50) + np.random.default_rng(3).normal(size=(50, 3)) * 0.05
    one, other = (fit_similarity(ring(50), target).target_from_source.params for _ in range(2))
    assert one.tobytes() == other.tobytes()


def test_positions_on_a_line_are_refused():
    line = np.linspace(0, 10, 20)[:, None] * np.array([1.0, 2.0, 0.5])
    wobbling = line + np.random.default_rng(4).normal(size=line.shape) * 0.01
    with pytest.raises(InputError, match="line"):
        check_determined(fit_similarity(line, 2 * line), line, "positions")
    with pytest.raises(InputError, match="line"):
        check_determined(fit_similarity(wobbling, 2 * line), wobbling, "positions")


def test_positions_whose_errors_exceed_their_extent_are_refused():
    target = ring(12) + np.random.default_rng(5).normal(size=(12, 3)) * 3
    with pytest.raises(InputError, match="do not determine the scale"):
        check_determined(fit_similarity(ring(12), target), ring(12), "positions")


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_positions_are_refused(count):
    with pytest.raises(InputError, match="at least 3"):
        fit_similarity(ring()[:count], ring()[:count])


def test_positions_in_one_place_are_refused():
    with pytest.raises(InputError, match="one place"):
        fit_similarity(ring(5), np.ones((5, 3)))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_stretch_is_measured_and_named(axis):
    factors = np.ones(3)
    factors[axis] = 2.0
    turned = pycolmap.Rotation3d(np.array([0.2, -0.1, 0.9])) * ring()
    target = 30 * ring() * factors + np.random.default_rng(6).normal(size=(30, 3)) * 0.3
    found = stretch_between(turned, target)
    assert found is not None
    assert found.factor == pytest.approx(2, rel=0.1)
    assert abs(found.direction[axis]) > 0.99
    with pytest.raises(InputError, match=rf"along {AXES[axis]}.*factor of (1\.9|2\.0)"):
        check_not_stretched(turned, target, "positions", AXES)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_noise_is_no_stretch(noise):
    for seed in range(5):
        target = ring() + np.random.default_rng(seed).normal(size=(30, 3)) * noise
        check_not_stretched(ring(), target, "positions", AXES)


def test_a_mirror_image_is_named():
    cube = np.random.default_rng(7).uniform(-1, 1, (20, 3))
    with pytest.raises(InputError, match="mirror"):
        check_not_stretched(cube, cube * [1, -1, 1], "positions", AXES)
