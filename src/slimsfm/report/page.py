"""The page: one HTML file that needs no network, no server and no other file."""

import json
from collections.abc import Iterator, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from slimsfm.evaluation.results import Run
from slimsfm.files import replacing
from slimsfm.mapping.map import Map
from slimsfm.report.failures import queries_html
from slimsfm.report.figure_files import method_charts
from slimsfm.report.formatting import (
    format_dominating_set,
    format_gain,
    format_line,
    format_map,
    rows_html,
)
from slimsfm.report.graph_view import GraphDrawing, graph_html
from slimsfm.report.map_support import left_out_html, support_html
from slimsfm.report.overview import charts_html, overview_html
from slimsfm.report.report_data import (
    ReportBudget,
    ReportData,
    RunMaps,
    load_report_data,
    load_run_maps,
    report_budget,
)
from slimsfm.report.scene3d import scene_json
from slimsfm.report.tradeoffs import frontier_chart

# the browser fetches nothing, whatever text the page contains
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
_TITLES = {"full": "Full", "dominating": "Dominating set", "default": "Default"}
_SCRIPTS = ("viewer.js", "graph.js", "table.js", "page.js")


def write_report(path: str | Path, run: Run, *, overwrite: bool = False) -> None:
    """Write the page. Equal input gives equal bytes.

    Raises:
        OutputError: The file exists and `overwrite` is off, or it cannot be written.
        MapError: A map of the run is missing or damaged.
        ValueError: The run has no object.
    """
    with replacing(Path(path), overwrite=overwrite) as partial:
        partial.write_text(report_html(run), encoding="utf-8")


def report_html(run: Run) -> str:
    """The page as text.

    Raises:
        MapError: A map of the run is missing or damaged.
        ValueError: The run has no object.
    """
    data = load_report_data(run)
    anchors = {one.name: f"object-{number}" for number, one in enumerate(run.objects, start=1)}
    objects = _objects(data, anchors)  # first, because maps can be missing
    parts = [overview_html(data, anchors), objects, _measurement_html(run)]
    return _document(escape(f"{run.dataset}: what a reduced map keeps and costs"), "\n".join(parts))


def _document(title: str, main: str) -> str:
    scripts = "".join(f"{{\n{_asset(name)}}}\n" for name in _SCRIPTS)  # each in its own block
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


def _objects(data: ReportData, anchors: Mapping[str, str]) -> str:
    """One section per object, the first one open; `anchors` are the link targets by name.

    Raises:
        MapError: A map of the run is missing or damaged.
    """
    sections = []
    for result in data.run.objects:
        lines = data.headlines(result.name)
        method = lines[0].after[0] if lines else result.maps[0].method
        maps = load_run_maps(data.run, result, method)
        sections.append(_section(maps, data, anchors[result.name], is_open=not sections))
    return "\n".join(sections)


def _section(maps: RunMaps, data: ReportData, anchor: str, *, is_open: bool) -> str:
    result, lines = maps.result, data.headlines(maps.result.name)
    budget = report_budget(len(data.run.objects), len(maps.maps["full"].images))
    said = " ".join(
        f"{format_line(one.after, data.methods).capitalize()}: {format_gain(one)}." for one in lines
    )
    method = f"Maps and graph are from {escape(maps.mapped.method)}. " if len(data.methods) > 1 else ""
    charts = method_charts(maps).values() if lines else ()
    drawing = GraphDrawing(graph=maps.graph, threshold=maps.threshold, chosen=maps.mapped.dominating_set)
    return f"""<details class="card object" id="{anchor}"{" open" * is_open}>
<summary><h2>{escape(result.name)}</h2><p class="headline">{escape(said)}</p></summary>
<p>{method}{escape(format_dominating_set(maps.mapped))}</p>
{_view(maps, budget)}
<h3>Support of the full map</h3>
{support_html(maps.mapped)}{left_out_html(result)}
<h3>Reference graph</h3>
{graph_html(drawing, result.images, budget.photo_px)}
<h3>Accuracy and speed</h3>
{rows_html(data.rows[result.name], [key for one in lines for key in (one.before, one.after)])}
<p class="note">Accuracy in % of {len(result.queries)} queries. Small print: 95 % intervals. d is the diagonal
of the object's box. Lines of the headline have a red background. Click on a header to sort.</p>
{queries_html(result, lines[0], budget) if lines else ""}
<h3>Charts</h3>
{charts_html([frontier_chart(data.rows[result.name]), *charts])}
</details>"""


def _view(maps: RunMaps, budget: ReportBudget) -> str:
    shown = scene_json(maps.maps, maps.mapped.dominating_set, max_points=budget.points)
    data = json.dumps(shown, separators=(",", ":")).replace("<", "\\u003c")
    return f"""<div class="view">
<div class="switch" role="group" aria-label="Which map is shown">{_buttons(maps.maps)}</div>
<canvas tabindex="0" role="img" aria-label="The map in 3D; arrow keys turn it, + and - zoom"></canvas>
<p class="note"><span class="chosen">Red</span>: images of the dominating set.
<span class="dropped">Gray</span>: the other images. <span class="box">Blue</span>: the object's box. Drag to
turn, use the wheel or pinch to zoom, double-click to reset.</p>
<script type="application/json">{data}</script>
</div>"""


def _buttons(maps: Mapping[str, Map]) -> str:
    return "".join(
        f'<button data-show="{escape(variant)}" aria-pressed="{str(variant == "full").lower()}">'
        f"<b>{escape(_TITLES.get(variant, variant))}</b> {format_map(one)}</button>"
        for variant, one in maps.items()
    )


def _measurement_html(run: Run) -> str:
    """Data set, command, options and environment."""
    options = {name: value for name, value in run.options.items() if name != "command"}
    parts = {"Options": options, "Environment": run.environment}
    lists = "\n".join(f"<div><h3>{title}</h3>\n{_list(values)}</div>" for title, values in parts.items())
    command = f"<pre>{escape(_short_paths(run.options['command']))}</pre>" if "command" in run.options else ""
    return f"""<section class="card"><h2>How this was measured</h2>
<p>{escape(run.dataset)}</p>{command}
<div class="lists">
{lists}
</div></section>"""


def _list(values: Mapping[str, Any]) -> str:
    items = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(_short_paths(text))}</dd>" for name, text in _flat(values)
    )
    return f"<dl>{items}</dl>"


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Names and values; names of nested values are joined by dots."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{name}", ", ".join(str(one) for one in value)
        elif value is not None:
            yield f"{prefix}{name}", str(value)


def _short_paths(text: str) -> str:
    """Replace absolute paths by their last part: a page does not reveal folders of the machine."""
    return " ".join(Path(word).name or word if word.startswith("/") else word for word in text.split(" "))
