"""The site is built and can be read without a network."""

import importlib
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from slimsfm.cli import COMMANDS
from slimsfm.datasets import DATASETS

ROOT = Path(__file__).parents[2]
PACKAGES = (
    *("mapping", "features", "graph", "domination", "selection", "reduction"),
    *("localization", "tracking", "evaluation", "datasets", "report"),
)
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src"}
LINKS_NOT_LOADED = {"canonical", "next", "prev"}
FAR = re.compile(r"\s*(?:https?:)?//")
FAR_IN_STYLE = re.compile(r"(?:url\(|@import)\s*[\"']?\s*(?:https?:)?//")


class Loading(HTMLParser):
    """Collects what a browser loads for a page, and the anchors of the page."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag, attrs):
        given = {name: value or "" for name, value in attrs}
        self.anchors.add(given.get("id", ""))
        self.loaded.append(given.get(LOADED.get(tag, ""), ""))
        self.loaded += [one.strip() for one in given.get("srcset", "").split(",")]
        if tag == "link" and given.get("rel") not in LINKS_NOT_LOADED:
            self.loaded.append(given.get("href", ""))


def read(page: Path) -> Loading:
    parser = Loading()
    parser.feed(page.read_text(encoding="utf-8"))
    return parser


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    for needed in ("material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(needed, reason=f"needs {needed}: pip install 'slimsfm[docs]'")
    folder = tmp_path_factory.mktemp("site")
    nowhere = "http://127.0.0.1:9"  # nothing answers here
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "http_proxy": nowhere, "https_proxy": nowhere},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_a_page_loads_nothing_from_a_network(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        text = page.read_text(encoding="utf-8")
        far = [one for one in read(page).loaded if FAR.match(one)]
        assert far == [], page
        assert not FAR_IN_STYLE.search(text), page
        assert 'class="mermaid"' not in text, page  # the theme would download a library for it
    for style in site.rglob("*.css"):
        assert not FAR_IN_STYLE.search(style.read_text(encoding="utf-8")), style


def test_everything_a_page_loads_exists(site):
    for page in sorted(site.rglob("*.html")):
        if page.name == "404.html":  # served from anywhere: its links start at the root of the site
            continue
        for one in read(page).loaded:
            if one and not one.startswith("data:"):
                assert (page.parent / one.partition("?")[0].partition("#")[0]).exists(), (page, one)


def test_pages_read_from_disk_can_be_searched(site):
    assert "var __index = " in (site / "search" / "search_index.js").read_text(encoding="utf-8")
    assert "javascripts/iframe-worker.js" in (site / "index.html").read_text(encoding="utf-8")


def test_every_command_and_data_set_is_on_the_page_of_commands(site):
    anchors = read(site / "commands.html").anchors
    assert anchors >= {name.split()[0] for name in COMMANDS}
    assert anchors >= {f"benchmark-{name}" for name in DATASETS}
    assert "--min-confidence" in (site / "commands.html").read_text(encoding="utf-8")


def test_everything_public_is_on_the_pages_of_python(site):
    for package in PACKAGES:
        anchors = read(site / "api" / f"{package}.html").anchors
        names = getattr(importlib.import_module(f"slimsfm.{package}"), "__all__", ())
        shown = {anchor.rpartition(".")[2] for anchor in anchors if anchor.startswith(f"slimsfm.{package}.")}
        assert shown >= set(names), package
        assert len(anchors) > 20, package


def test_formulas_are_mathml(site):
    text = (site / "method.html").read_text(encoding="utf-8")
    assert text.count("<math") > 50
    assert "arithmatex" not in text
    assert not re.search(r"\$\$|\\frac|\\\(", text)


def test_every_page_of_the_navigation_is_written():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = re.findall(r"\S+\.md", text[text.index("\nnav:") : text.index("\nhooks:")])
    assert len(pages) > 25
    made = {"changelog.md", "contributing.md", "walkthrough.md"}  # from files elsewhere
    assert [page for page in pages if page not in made and not (ROOT / "docs" / page).is_file()] == []
