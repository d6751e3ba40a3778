"""All that the page tells of one object."""

import json
from collections.abc import Mapping
from html import escape

from slimsfm.mapping.map import Map
from slimsfm.report.budget import Budget, budget_for
from slimsfm.report.drawn_charts import object_charts
from slimsfm.report.formatting import contents, domination, gain, line_name
from slimsfm.report.graph_view import GraphView, graph_html
from slimsfm.report.queries import queries_html
from slimsfm.report.report_data import Story
from slimsfm.report.run_maps import OpenedObject, open_object
from slimsfm.report.scene3d import scene
from slimsfm.report.table import rows_html


def objects_html(story: Story, anchors: Mapping[str, str]) -> str:
    """A section an object, of which the first is open; `anchors` are what links to objects name.

    Raises:
        MapError: A map of the run is missing or damaged.
    """
    sections = []
    for result in story.run.objects:
        lines = story.headlines(result.name)
        method = lines[0].after[0] if lines else result.maps[0].method
        opened = open_object(story.run, result, method)
        sections.append(_object(opened, story, anchors[result.name], is_open=not sections))
    return "\n".join(sections)


def _object(opened: OpenedObject, story: Story, anchor: str, *, is_open: bool) -> str:
    """The object's section, which a click on its headline opens and closes."""
    name, lines = opened.result.name, story.headlines(opened.result.name)
    budget = budget_for(len(story.run.objects), len(opened.maps["full"].images))
    said = " ".join(f"{line_name(one.after, story.methods).capitalize()}: {gain(one)}." for one in lines)
    return f"""<details class="card object" id="{anchor}"{" open" * is_open}>
<summary><h2>{escape(name)}</h2><p class="headline">{escape(said)}</p></summary>
<p>{_of_method(opened, story)}{escape(domination(opened.mapped))}</p>
{_view(opened, budget)}
<h3>Reference graph</h3>
{graph_html(_graph(opened, budget))}
<h3>Accuracy and speed</h3>
{rows_html(story.rows[name], [key for one in lines for key in (one.before, one.after)])}
{_note(opened)}
{queries_html(opened.result, lines[0], budget) if lines else ""}
<h3>Charts</h3>
{object_charts(opened, story, lines)}
</details>"""


def _of_method(opened: OpenedObject, story: Story) -> str:
    return f"Maps and graph are those of {escape(opened.mapped.method)}. " if len(story.methods) > 1 else ""


def _graph(opened: OpenedObject, budget: Budget) -> GraphView:
    return GraphView(
        graph=opened.graph,
        threshold=opened.threshold,
        chosen=opened.mapped.dominating_set,
        images=opened.result.images,
        photo_px=budget.photo_px,
    )


def _note(opened: OpenedObject) -> str:
    return (
        f'<p class="note">Accuracy in % of {len(opened.result.queries)} queries, in small print 95 % '
        "intervals; d is the diagonal of the object's box. The headline is about the lines on red ground. "
        "A click on a header sorts.</p>"
    )


def _view(opened: OpenedObject, budget: Budget) -> str:
    shown = scene(opened.maps, opened.mapped.dominating_set, max_points=budget.points)
    data = json.dumps(shown, separators=(",", ":")).replace("<", "\\u003c")
    return f"""<div class="view">
<div class="switch" role="group" aria-label="Which map is shown">{_buttons(opened.maps)}</div>
<canvas tabindex="0" role="img" aria-label="The map in 3D; arrow keys turn it, + and - zoom"></canvas>
<p class="note"><span class="chosen">Red</span>: images of the dominating set.
<span class="dropped">Grey</span>: the other images. <span class="box">Blue</span>: the object's box. Drag to
turn, wheel or pinch to zoom, double-click to start over.</p>
<script type="application/json">{data}</script>
</div>"""


def _buttons(maps: Mapping[str, Map]) -> str:
    return "".join(
        f'<button data-show="{escape(variant)}" aria-pressed="{str(variant == "full").lower()}">'
        f"<b>{escape(_TITLES.get(variant, variant))}</b> {contents(map_)}</button>"
        for variant, map_ in maps.items()
    )


_TITLES = {"full": "Full", "dominating": "Dominating set", "default": "Default"}
