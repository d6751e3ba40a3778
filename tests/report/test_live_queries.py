import re

import numpy as np
import pytest
from PIL import Image

from browsing import browsing, opened, wait_until
from poster import poster_camera, poster_map, poster_photo, poster_pose
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import direct_map
from slimsfm.report.live_queries import QueryPanel
from slimsfm.report.live_stage import QUERY_RGB

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


def assert_localized(view, panel, word):
    wait_until(lambda: f", {word}: confidence" in panel.told.content)
    found = re.search(r"confidence ([\d.]+), (\d+) inliers, \d+ ms for features, \d+ ms", panel.told.content)
    assert float(found[1]) > 0.9
    assert int(found[2]) > 20
    frustum = view.server.scene.get_handle_by_name("/queries/poster.png")
    assert frustum.color == QUERY_RGB
    assert frustum.image.shape == (240, 320, 3)
    expected = view.stage.add_frustum("/true", "poster.png", poster_camera(), POSE, QUERY_RGB)
    np.testing.assert_allclose(frustum.position, expected.position, atol=0.02)
    assert abs(frustum.wxyz @ expected.wxyz) > 0.9999
    assert frustum.fov == pytest.approx(expected.fov)
    return frustum


def test_a_click_localizes_the_query_against_the_map_that_is_shown(poster, queries):
    with opened(poster, points_alone(poster)) as view, browsing(view) as browser:
        panel = QueryPanel(view, queries)
        browser.choose(panel.names, "poster.png")
        for word in ("Before", "After"):
            browser.press(view.switch[word])
            wait_until(lambda word=word: view.shown == word)
            browser.press(panel.button)
            frustum = assert_localized(view, panel, word.lower())
            wait_until(lambda: not panel.button.disabled)
        browser.click(frustum)
        wait_until(lambda: np.linalg.norm(browser.camera.position - frustum.position) < 0.5)


def test_the_chosen_query_is_shown(poster, queries):
    with opened(poster) as view, browsing(view) as browser:
        panel = QueryPanel(view, queries)
        assert panel.names.options == ("narrow.png", "noise.png", "poster.png", "words.png")
        assert panel.preview.image.shape == (240, 100, 3)
        browser.choose(panel.names, "poster.png")
        wait_until(lambda: panel.preview.image.shape == (240, 320, 3))


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("noise.png", "not localized"),
        ("narrow.png", "its focal length is unknown"),
        ("words.png", "not a readable image"),
    ],
)
def test_a_query_that_cannot_be_localized_is_told(poster, queries, name, why):
    with opened(poster) as view, browsing(view) as browser:
        panel = QueryPanel(view, queries)
        browser.choose(panel.names, name)
        browser.press(panel.button)
        wait_until(lambda: why in panel.told.content)
        wait_until(lambda: not panel.button.disabled)
        assert view.server.scene.get_handle_by_name(f"/queries/{name}") is None


def test_a_query_that_is_not_found_again_loses_its_frustum(poster, queries, tmp_path):
    query = tmp_path / "one.png"
    query.write_bytes((queries / "poster.png").read_bytes())
    with opened(poster) as view, browsing(view) as browser:
        panel = QueryPanel(view, tmp_path)
        browser.press(panel.button)
        wait_until(lambda: view.server.scene.get_handle_by_name("/queries/one.png"))
        wait_until(lambda: not panel.button.disabled)
        query.write_bytes((queries / "noise.png").read_bytes())
        browser.press(panel.button)
        wait_until(lambda: view.server.scene.get_handle_by_name("/queries/one.png") is None)


def test_an_unknown_focal_length_need_not_be_given(poster, queries):
    with opened(poster) as view, browsing(view) as browser:
        panel = QueryPanel(view, queries, focal="unknown")
        browser.choose(panel.names, "narrow.png")
        browser.press(panel.button)
        wait_until(lambda: "not localized" in panel.told.content)
        wait_until(lambda: not panel.button.disabled)


def test_what_runs_is_waited_for_at_the_end(poster, queries):
    with opened(poster) as view, browsing(view) as browser:
        panel = QueryPanel(view, queries)
        browser.choose(panel.names, "poster.png")
        browser.press(panel.button)
        wait_until(lambda: panel.button.disabled)
    assert "confidence" in panel.told.content
    assert view.server.scene.get_handle_by_name("/queries/poster.png") is not None
