import re

import numpy as np
import pytest
from PIL import Image

from browsing import Browser, browsing, opened, wait_until
from poster import poster_camera, poster_map, poster_photo, poster_pose
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import direct_map
from slimsfm.report.live_panel import QUERY_RGB

POSE = poster_pose((0.3, -0.3, -3.1))


@pytest.fixture(scope="module")
def poster():
    return poster_map()


@pytest.fixture(scope="module")
def queries(tmp_path_factory):
    folder = tmp_path_factory.mktemp("queries")
    noise = np.random.default_rng(1).integers(0, 256, (240, 320, 3), np.uint8)
    Image.fromarray(poster_photo(POSE)).save(folder / "poster.png")
    Image.fromarray(noise).save(folder / "noise.png")
    Image.fromarray(noise[:, :100]).save(folder / "narrow.png")
    (folder / "words.png").write_text("no image")
    return folder


def points_alone(map):
    """Each point with the descriptor that the first image has of it."""
    seen = map.observations["1.png"]
    descriptors = map.features["1.png"].descriptors[seen.rows].astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    order = np.argsort(seen.points)
    return direct_map(map, PointDescriptors(points=seen.points[order], descriptors=descriptors[order]))


def assert_localized(browser, prefix):
    message = browser.queries.message
    wait_until(lambda: f"{prefix}: confidence" in message.content)
    found = re.search(r"confidence ([\d.]+), (\d+) inliers, \d+ ms for features, \d+ ms", message.content)
    assert float(found[1]) > 0.9
    assert int(found[2]) > 20
    frustum = browser.scene.get_handle_by_name("/queries/poster.png")
    assert frustum.color == QUERY_RGB
    assert frustum.image.shape == (240, 320, 3)
    expected = browser.viewer.add_frustum("/true", poster_camera(), POSE, QUERY_RGB)
    np.testing.assert_allclose(frustum.position, expected.position, atol=0.02)
    assert abs(frustum.wxyz @ expected.wxyz) > 0.9999
    assert frustum.fov == pytest.approx(expected.fov)
    return frustum


def test_a_click_localizes_with_the_map_that_is_shown_and_flies_to_the_pose(poster, queries):
    with opened(poster, points_alone(poster), queries) as view, browsing(view) as browser:
        browser.choose(browser.queries.names, "poster.png")
        for key in ("Before", "After"):
            start = browser.camera.position.copy()
            browser.press(browser.viewer.switch[key])
            wait_until(lambda key=key: browser.viewer.shown == key)
            browser.press(browser.queries.button)
            frustum = assert_localized(browser, f", {key.lower()}")
            wait_until(lambda: not browser.queries.button.disabled)
            wait_until(lambda frustum=frustum: abs(browser.camera.wxyz @ frustum.wxyz) > 1 - 1e-9)
            assert np.linalg.norm(browser.camera.position - frustum.position) < 0.5
            assert key == "After" or np.linalg.norm(browser.camera.position - start) > 0.5


def test_the_name_of_a_single_map_is_omitted(poster, queries):
    with opened(poster, None, queries) as view, browsing(view) as browser:
        browser.choose(browser.queries.names, "poster.png")
        browser.press(browser.queries.button)
        assert_localized(browser, "**")
        assert "before" not in browser.queries.message.content


def test_each_viewer_has_its_own_query(poster, queries):
    with opened(poster, None, queries) as view, browsing(view) as one, browsing(view) as other:
        one.choose(one.queries.names, "poster.png")
        one.press(one.queries.button)
        assert_localized(one, "**")
        assert other.queries.names.value == "narrow.png"
        assert other.queries.message.content == ""
        assert other.scene.get_handle_by_name("/queries/poster.png") is None


def test_the_chosen_query_is_shown(poster, queries):
    with opened(poster, None, queries) as view, browsing(view) as browser:
        panel = browser.queries
        assert panel.names.options == ("narrow.png", "noise.png", "poster.png", "words.png")
        assert panel.preview.image.shape == (240, 100, 3)
        browser.choose(panel.names, "poster.png")
        wait_until(lambda: panel.preview.image.shape == (240, 320, 3))


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("noise.png", "not localized"),
        ("words.png", "not a readable image"),
    ],
)
def test_a_query_that_cannot_be_localized_is_reported(poster, queries, name, why):
    with opened(poster, None, queries) as view, browsing(view) as browser:
        browser.choose(browser.queries.names, name)
        browser.press(browser.queries.button)
        wait_until(lambda: why in browser.queries.message.content)
        wait_until(lambda: not browser.queries.button.disabled)
        assert browser.scene.get_handle_by_name(f"/queries/{name}") is None


def test_a_query_that_is_not_localized_again_loses_its_frustum(poster, queries, tmp_path):
    query = tmp_path / "one.png"
    query.write_bytes((queries / "poster.png").read_bytes())
    with opened(poster, None, tmp_path) as view, browsing(view) as browser:
        browser.press(browser.queries.button)
        wait_until(lambda: browser.scene.get_handle_by_name("/queries/one.png"))
        wait_until(lambda: not browser.queries.button.disabled)
        query.write_bytes((queries / "noise.png").read_bytes())
        browser.press(browser.queries.button)
        wait_until(lambda: browser.scene.get_handle_by_name("/queries/one.png") is None)


@pytest.mark.parametrize(
    ("options", "why"), [({}, "not localized"), ({"focal": "known"}, "its focal length is unknown")]
)
def test_an_unknown_focal_length_is_refused_only_on_request(poster, queries, options, why):
    with opened(poster, None, queries, **options) as view, browsing(view) as browser:
        browser.choose(browser.queries.names, "narrow.png")
        browser.press(browser.queries.button)
        wait_until(lambda: why in browser.queries.message.content)
        wait_until(lambda: not browser.queries.button.disabled)


def test_a_running_localization_is_finished_at_the_end(poster, queries):
    with opened(poster, None, queries) as view:
        browser = Browser(view)
        browser.choose(browser.queries.names, "poster.png")
        browser.press(browser.queries.button)
        wait_until(view.busy.locked)
    assert "confidence" in browser.queries.message.content
    assert browser.scene.get_handle_by_name("/queries/poster.png") is not None
    browser.close()
