"""Adds files outside docs/ to the site: the changelog, the guide for contributors, the examples.

Links in the files are relative to their place in the repository, as on GitHub. They are rewritten here.
"""

import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "examples/slimsfm.ipynb": "walkthrough.md",
}
"""Files outside docs/ and their pages."""

_COPIED = ("*.py", "*.toml", "*.ipynb")
_CODE = r"^(?P<fence>`{3,}).*?^(?P=fence)|`[^`\n]+`"
_LINK = re.compile(_CODE + r"|(?<=\]\()(?!\w+:|#|/)(?P<target>[^)\s#]+)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages, and the examples as files to download."""
    root = Path(config.config_file_path).parent
    for source, page in PAGES.items():
        if not files.get_file_from_path(page):
            files.append(File.generated(config, page, content=(root / source).read_text(encoding="utf-8")))
    for pattern in _COPIED:
        for path in sorted((root / "examples").rglob(pattern)):
            name = path.relative_to(root).as_posix()
            files.append(File.generated(config, name, content=path.read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Rewrite links between files of the repository as links between pages of the site."""
    sources = {place: source for source, place in PAGES.items() if place != "index.md"}
    here = PurePosixPath(sources.get(page.file.src_uri, f"docs/{page.file.src_uri}"))

    def turned(match: re.Match[str]) -> str:
        if match["target"] is None:
            return match[0]
        target = place_of(normpath(here.parent / match["target"]))
        return relpath(target, PurePosixPath(page.file.src_uri).parent)

    return _LINK.sub(turned, markdown)


def place_of(path: str) -> str:
    """Return the place on the site of a file of the repository."""
    return PAGES.get(path, path.removeprefix("docs/"))
