"""The page: one HTML file that needs no network, no server and nothing beside it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

from slimsfm.evaluation.table import Row
from slimsfm.files import replacing
from slimsfm.mapping.map import Map
from slimsfm.report.frames import QueryFrame, frame_html
from slimsfm.report.scene3d import scene
from slimsfm.report.table import table_html
from slimsfm.report.words import contents, headline

# Whatever else may slip into the page, the browser fetches nothing for it.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectReport:
    """What the page tells of one object or scene."""

    name: str
    """Its name."""

    full: Map
    """The map before."""

    reduced: Map
    """The map after, with some of the images of `full`."""

    rows: tuple[Row, ...]
    """The table, in the order shown at first."""

    frames: tuple[QueryFrame, ...]
    """Queries to show; a few are enough."""


def write_report(path: Path, objects: Sequence[ObjectReport], *, title: str, overwrite: bool) -> None:
    """Write the page. Equal input gives equal bytes.

    Raises:
        OutputError: The file exists and `overwrite` is off, or cannot be written.
    """
    with replacing(path, overwrite=overwrite) as partial:
        partial.write_text(report_html(objects, title=title), encoding="utf-8")


def report_html(objects: Sequence[ObjectReport], *, title: str) -> str:
    """The page as text.

    Raises:
        ValueError: There is no object.
    """
    if not objects:
        raise ValueError("objects must hold at least one object")
    sections = "\n".join(_section(one) for one in objects)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>
{_asset("page.css")}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<main>
{sections}
</main>
<script>
{_asset("viewer.js")}
{_asset("table.js")}</script>
</body>
</html>
"""


def _section(one: ObjectReport) -> str:
    return f"""<section>
<h2>{escape(one.name)}</h2>
<p class="headline">{escape(headline(one.full, one.reduced, one.rows))}</p>
{_view(one)}
{_table(one.rows)}
{_frames(one)}
</section>"""


def _view(one: ObjectReport) -> str:
    data = json.dumps(scene(one.full, one.reduced), separators=(",", ":")).replace("<", "\\u003c")
    buttons = "".join(
        f'<button data-show="{key}" aria-pressed="{str(key == "before").lower()}">'
        f"<b>{word}</b> {contents(shown)}</button>"
        for key, word, shown in (("before", "Before", one.full), ("after", "After", one.reduced))
    )
    return f"""<div class="view">
<div class="switch" role="group" aria-label="Which map is shown">{buttons}</div>
<canvas tabindex="0" role="img" aria-label="The map in 3D; arrow keys turn it, + and - zoom"></canvas>
<p class="note"><span class="chosen">Red</span>: images kept. <span class="dropped">Grey</span>: images
dropped. <span class="box">Blue</span>: the object's box. Drag to turn, wheel or pinch to zoom, double-click
to start over.</p>
<script type="application/json">{data}</script>
</div>"""


def _table(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    queries = sorted({row.scores.queries for row in rows})
    count = " to ".join(f"{n:,}" for n in sorted({queries[0], queries[-1]}))
    return f"""<h3>Accuracy and speed</h3>
{table_html(rows)}
<p class="note">Accuracy in % of {count} queries; d is the diagonal of the object's box. A click on a header
sorts.</p>"""


def _frames(one: ObjectReport) -> str:
    if not one.frames:
        return ""
    figures = "\n".join(frame_html(frame, one.full.box) for frame in one.frames)
    return f"""<h3>Queries</h3>
<p class="note"><span class="estimated">Red</span>: the box under the estimated pose.
<span class="true">Green</span>: under the true one.</p>
<div class="frames">
{figures}
</div>"""


def _asset(name: str) -> str:
    return files("slimsfm.report").joinpath(name).read_text(encoding="utf-8")
