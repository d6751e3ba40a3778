"""The commands of the start page and the how-to guides run, page by page, in a folder with their inputs."""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import slimsfm

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ["index.md", *(f"how-to/{path.name}" for path in sorted((DOCS / "how-to").glob("*.md")))]

NOT_TYPED = (
    "pip install ",  # the tests run with the installed packages
    "ffmpeg ",  # the Python lines next to it do the same
    "slimsfm demo",  # takes minutes, and is one of the two commands that README promises
    "slimsfm serve ",  # runs until it is stopped
    "slimsfm view ",  # runs until it is stopped
    "slimsfm align map -o metric --tag-size",  # no tag is in these photos; tests/upkeep has some
    "slimsfm align map -o placed --gps",  # nor GPS
)
"""Lines that start like this are skipped. Every other line is run."""

NOT_INSTALLED = ("hloc",)
"""Packages that the tests cannot require. Python lines that import one are compiled, not run."""

GIVEN = {"how-to/own-matcher.md": ("map",), "how-to/meters-and-place.md": ("map", "positions.csv")}
"""Further inputs of a page."""

_BLOCK = re.compile(r"^```(?P<language>\w*)\n(?P<lines>.*?)^```$", re.MULTILINE | re.DOTALL)


def examples(page: str) -> Iterator[tuple[str, str]]:
    """The blocks of a page that can be run, in order, as language and lines."""
    for match in _BLOCK.finditer((DOCS / page).read_text(encoding="utf-8")):
        language = match["language"]
        if not language and match["lines"].startswith("slimsfm "):
            language = "sh"
        if language in ("sh", "python"):
            yield language, match["lines"]


def type_line(line: str) -> None:
    if line.startswith(NOT_TYPED) or line.startswith("#"):
        return
    program, *arguments = shlex.split(line, comments=True)
    assert program == "slimsfm", f"{line}: lines that the tests do not run belong in NOT_TYPED"
    done = slimsfm(*arguments)
    assert done.code == 0, f"{line}\n{done.err}"


def imports(lines: str, package: str) -> bool:
    return re.search(rf"^(from|import) {package}\b", lines, re.MULTILINE) is not None


@pytest.fixture
def page(filmed: Path, projects: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request) -> str:
    """A page with its inputs in the current folder."""
    place = tmp_path / "place"
    shutil.copytree(filmed, place)
    for name in ("project", "outputs", "queries.txt", "box3d_corners.txt", *GIVEN.get(request.param, ())):
        copy = shutil.copytree if (projects / name).is_dir() else shutil.copy
        copy(projects / name, place / name)
    monkeypatch.chdir(place)
    return request.param


@pytest.mark.usefixtures("own_matcher")
@pytest.mark.parametrize("page", PAGES, indirect=True)
def test_the_commands_of_a_page_work(page):
    space = {"__name__": "__main__"}
    for number, (language, lines) in enumerate(examples(page)):
        if language == "sh":
            for line in lines.splitlines():
                type_line(line)
        else:
            code = compile(lines, f"{page}, block {number}", "exec")
            if not any(imports(lines, package) for package in NOT_INSTALLED):
                exec(code, space)


def test_every_page_has_something_that_is_run():
    for page in PAGES:
        lines = [line for language, text in examples(page) if language == "sh" for line in text.splitlines()]
        is_typed = any(not line.startswith(NOT_TYPED) for line in lines)
        assert is_typed or any(language == "python" for language, _ in examples(page)), page
