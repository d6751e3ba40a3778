"""The page: one HTML file that needs no network, no server and nothing beside it."""

from html import escape
from importlib.resources import files
from pathlib import Path

from slimsfm.evaluation.results import Run
from slimsfm.files import replacing
from slimsfm.report.provenance import provenance_html

# Whatever else may slip into the page, the browser fetches nothing for it.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
_SCRIPTS = ("viewer.js", "graph.js", "table.js", "page.js")


def write_report(path: Path, run: Run, *, overwrite: bool) -> None:
    """Write the page. Equal input gives equal bytes.

    Raises:
        OutputError: The file exists and `overwrite` is off, or cannot be written.
        MapError: A map of the run is missing or damaged.
        ValueError: The run has no object.
    """
    with replacing(path, overwrite=overwrite) as partial:
        partial.write_text(report_html(run), encoding="utf-8")


def report_html(run: Run) -> str:
    """The page as text.

    Raises:
        MapError: A map of the run is missing or damaged.
        ValueError: The run has no object.
    """
    # these import matplotlib and networkx, for which whoever writes no page is not to wait
    from slimsfm.report.object_section import objects_html
    from slimsfm.report.overview import overview_html
    from slimsfm.report.report_data import story_of

    story = story_of(run)
    anchors = {one.name: f"object-{number}" for number, one in enumerate(run.objects, start=1)}
    objects = objects_html(story, anchors)  # first, for maps may be missing
    parts = [overview_html(story, anchors), objects, provenance_html(run)]
    return _whole(escape(f"{run.dataset}: what a slim map keeps and costs"), "\n".join(parts))


def _whole(title: str, main: str) -> str:
    scripts = "".join(f"{{\n{_asset(name)}}}\n" for name in _SCRIPTS)  # in blocks of their own
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
{_asset("page.css")}</style>
</head>
<body>
<h1>{title}</h1>
<main>
{main}
</main>
<script>
{scripts}</script>
</body>
</html>
"""


def _asset(name: str) -> str:
    return files("slimsfm.report").joinpath(name).read_text(encoding="utf-8")
