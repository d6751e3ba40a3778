"""What lies outside docs/ and belongs on the site: the changelog, how to contribute, the examples.

Links are written as GitHub wants them, from where a file lies in the repository; they are turned here.
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
"""Files outside docs/ and the pages that stand for them."""

_COPIED = ("*.py", "*.toml", "*.ipynb")
_CODE = r"^(?P<fence>`{3,}).*?^(?P=fence)|`[^`\n]+`"
_LINK = re.compile(_CODE + r"|(?<=\]\()(?!\w+:|#|/)(?P<target>[^)\s#]+)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages, and the examples as files."""
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
    """Turn links between places in the repository into links between places on the site."""
    sources = {place: source for source, place in PAGES.items() if place != "index.md"}
    here = PurePosixPath(sources.get(page.file.src_uri, f"docs/{page.file.src_uri}"))

    def turned(match: re.Match[str]) -> str:
        if match["target"] is None:
            return match[0]
        target = place_of(normpath(here.parent / match["target"]))
        return relpath(target, PurePosixPath(page.file.src_uri).parent)

    return _LINK.sub(turned, markdown)


def place_of(path: str) -> str:
    """Where a file of the repository is found on the site."""
    return PAGES.get(path, path.removeprefix("docs/"))
