from dataclasses import replace

import numpy as np
import pytest

from hard_light import BRIGHT, CONDITIONS, DARK, GAMMA, SEED, Condition, Studio, exposed, streak
from slimsfm.geometry import project
from slimsfm.synthetic import shapes
from slimsfm.synthetic.render import visible_meshes
from slimsfm.synthetic.scene import query_take, textured_object

NAME = "printed_box"
TABLE = 1  # index of the table among the meshes of a query scene


@pytest.fixture(scope="module")
def take():
    return query_take(NAME, 6, 160, 120, SEED)


@pytest.fixture(scope="module")
def studio(take):
    return Studio(NAME, take)


def gray(value):
    return np.full((80, 100, 3), value)


@pytest.mark.parametrize("name", sorted(CONDITIONS))
def test_light_is_between_ambient_light_and_the_whole_lamp(studio, name):
    condition = CONDITIONS[name]
    albedo = studio.radiance(replace(condition, lamp=DARK, ambient=BRIGHT), 0)
    found = studio.radiance(condition, 0)
    assert np.all(found >= albedo * condition.ambient - 1e-12)
    assert np.all(found <= albedo * (np.array(condition.ambient) + condition.lamp) + 1e-12)
    assert np.any(found > 1.1 * albedo * condition.ambient)


@pytest.mark.parametrize("towards", [CONDITIONS["day"].towards, CONDITIONS["night"].towards])
def test_the_object_casts_its_shadow_on_the_table(take, studio, towards):
    lamp = Condition(towards=towards, ambient=DARK)
    lowest = shapes.lowest(textured_object(NAME, SEED))
    on_table = np.array(
        [np.array(towards) * lowest / towards[2]]
    )  # the ray to the lamp meets the box's center
    seen = 0
    for frame, pose in enumerate(take.cam_from_object):
        column, row = np.floor(project(on_table, pose, take.camera)[0]).astype(int)
        if not (0 <= column < 160 and 0 <= row < 120):
            continue
        if visible_meshes(studio._colors, take.camera, pose)[row, column] == TABLE:
            seen += 1
            assert studio.radiance(lamp, frame)[row, column].max() < 1e-3
    assert seen


def test_slats_take_away_light_and_add_none(studio):
    condition = CONDITIONS["shadows"]
    behind, free = studio.radiance(condition, 0), studio.radiance(replace(condition, slats=False), 0)
    assert np.all(behind <= free + 1e-12)
    assert 0.2 < behind.sum() / free.sum() < 0.9


@pytest.mark.parametrize("value", [0.05, 0.2, 0.6])
def test_a_well_exposed_picture_has_the_radiance(value):
    image = exposed(gray(value), Condition(), np.random.default_rng(0))
    assert np.mean((image / 255.0) ** GAMMA) == pytest.approx(value, rel=0.01)


def test_overexposure_clips_and_noise_grows_as_photons_become_few():
    rng = np.random.default_rng(0)
    assert np.all(exposed(gray(0.2), CONDITIONS["over"], rng) == 255)
    many, few = (exposed(gray(0.3), CONDITIONS[name], rng).astype(float).std() for name in ("day", "noise"))
    assert few > 10 * many


def test_lifting_only_scales_gray_levels():
    ramp = np.linspace(0, 1, 100)[None, :, None] * gray(1.0)
    dark, lifted = (exposed(ramp, CONDITIONS[name], np.random.default_rng(2)) for name in ("under", "lifted"))
    assert dark.max() < 30
    assert lifted.max() == 255
    levels = [np.unique(lifted[dark == level]) for level in np.unique(dark)]
    assert all(len(one) == 1 for one in levels)
    assert np.all(np.diff(np.concatenate(levels).astype(int)) >= 0)


def test_motion_blur_keeps_the_middle():
    for angle in np.linspace(0, np.pi, 7):
        kernel = streak(13, angle)
        y, x = np.indices(kernel.shape)
        assert kernel.sum() == pytest.approx(1)
        assert (kernel * x).sum() == pytest.approx(6, abs=0.1)
        assert (kernel * y).sum() == pytest.approx(6, abs=0.1)


def test_equal_seeds_give_equal_pictures():
    condition = CONDITIONS["night"]
    one, other = (exposed(gray(0.4), condition, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one, other)
