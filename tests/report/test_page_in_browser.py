"""The page in a browser: what it draws, how it reacts, and that it fetches nothing."""

import numpy as np
import pytest

from browser import open_page

CANVAS = "#object-1 canvas"
NODE = "#object-1 .node:not(.kept)"


@pytest.fixture(scope="module")
def page(html, tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    (folder / "report.html").write_text(html, encoding="utf-8")
    with open_page(folder / "report.html", folder / "profile") as page:
        page.resize(1200, 900)
        yield page


def colors(pixels):
    return len(np.unique(pixels.reshape(-1, 4), axis=0))


def test_the_map_is_drawn_and_turns_when_dragged(page):
    before = page.pixels(CANVAS)
    assert colors(before) > 5
    page.drag(CANVAS, 120, 30)
    after = page.pixels(CANVAS)
    assert colors(after) > 5
    assert np.any(before != after)


def test_keys_turn_the_map(page):
    before = page.pixels(CANVAS)
    page.run(f"document.querySelector('{CANVAS}').focus()")
    page.press("ArrowLeft")
    assert np.any(before != page.pixels(CANVAS))


@pytest.mark.parametrize("variant", ["dominating", "default"])
def test_each_map_looks_different(page, variant):
    page.click("#object-1 [data-show=full]")
    full = page.pixels(CANVAS)
    page.click(f"#object-1 [data-show={variant}]")
    assert np.any(full != page.pixels(CANVAS))
    assert page.run(f"document.querySelector('#object-1 [data-show={variant}]').ariaPressed") == "true"


def test_pointing_at_a_photo_shows_its_name_and_degrees_and_highlights_its_edges(page):
    page.hover("#object-1 h2")
    described = "document.querySelector('#object-1 .details').innerText"
    assert "dominating set" in page.run(described)
    page.hover(NODE)
    name = page.run(f"document.querySelector('{NODE}').dataset.name")
    assert page.run(described).startswith(name)
    assert "others, is localized by" in page.run(described)
    assert page.run("document.querySelectorAll('#object-1 .edges .lit').length") > 0
    assert page.run("document.querySelector('#object-1 .details img').naturalWidth") > 0
    page.hover("#object-1 h2")
    assert page.run("document.querySelectorAll('#object-1 .edges .lit').length") == 0


def test_pointing_at_a_photo_highlights_its_camera_in_the_map(page):
    page.hover("#object-1 h2")
    before = page.pixels(CANVAS)
    page.hover(NODE)
    assert np.any(before != page.pixels(CANVAS))


def test_arrow_keys_move_through_the_graph(page):
    page.run("document.querySelector('#object-1 .node').focus()")
    visited = []
    for key in ("ArrowRight", "ArrowDown", "ArrowLeft", "ArrowUp"):
        page.press(key)
        visited.append(page.run("document.activeElement.dataset.name"))
        assert page.run("document.querySelector('#object-1 .details').innerText").startswith(visited[-1])
    assert len(set(visited)) > 1
    page.run("document.activeElement.blur()")


def test_a_click_on_a_header_sorts_and_a_second_one_reverses(page):
    table = "#object-1 table"
    column = (
        f"[...document.querySelectorAll('{table} tbody tr')].map(row => Number(row.cells[3].dataset.value))"
    )
    page.click(f"{table} th:nth-child(4)")
    points = page.run(column)
    assert len(set(points)) > 1
    assert points == sorted(points, reverse=True)
    page.click(f"{table} th:nth-child(4)")
    assert page.run(column) == sorted(points)


def test_a_filter_shows_the_rows_with_all_its_words(page):
    page.run("document.querySelector('.filter').value = 'direct FULL'")
    page.run("document.querySelector('.filter').dispatchEvent(new Event('input'))")
    rows = page.run(
        "[...document.querySelector('.filter').parentElement.querySelectorAll('tbody tr')]"
        ".filter(row => !row.hidden).map(row => row.innerText)"
    )
    assert len(rows) == 2
    assert all("direct" in row and "full" in row for row in rows)


def test_a_link_opens_the_section_of_its_object(page):
    assert not page.run("document.getElementById('object-2').open")
    page.click("a[href='#object-2']")
    page.settle()
    assert page.run("document.getElementById('object-2').open")
    assert colors(page.pixels("#object-2 canvas")) > 5


def test_the_page_fits_a_phone(page):
    page.resize(360, 740, mobile=True)
    assert page.run("document.documentElement.scrollWidth") <= 360
    page.resize(1200, 900)


def test_dark_looks_different(page):
    page.prefer("light")
    light = page.screenshot()
    page.prefer("dark")
    dark = page.screenshot()
    page.prefer("light")
    assert light.mean() > 150
    assert dark.mean() < 100


def test_the_page_logs_no_errors_and_fetches_nothing(page):
    assert page.complaints() == []
    assert [address for address in page.requests() if not address.startswith("file:")] == []
    assert len(page.requests()) == 1
