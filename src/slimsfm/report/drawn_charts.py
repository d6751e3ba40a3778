"""Charts as parts of the page."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from slimsfm.evaluation.comparison import Comparison
from slimsfm.evaluation.results import join_outcomes
from slimsfm.evaluation.table import BY_FRAME
from slimsfm.report.charts import (
    frontier_chart,
    query_places,
    reference_places,
    reliability_chart,
    sphere_chart,
)
from slimsfm.report.figures import figure_svg
from slimsfm.report.report_data import Story
from slimsfm.report.run_maps import OpenedObject

_CSS_PX = 96  # to an inch


def average_charts(story: Story, lines: Sequence[Comparison]) -> str:
    """Charts over all objects; `lines` are those that headlines are about."""
    figures = [frontier_chart(story.rows[BY_FRAME])]
    if lines:
        some = [found for one in story.run.objects if (found := one.measurement(*lines[0].after))]
        figures.append(reliability_chart(join_outcomes([one.outcomes for one in some])))
    return _charts(figures)


def object_charts(opened: OpenedObject, story: Story, lines: Sequence[Comparison]) -> str:
    """Charts of one object; `lines` are those that headlines are about."""
    result = opened.result
    figures = [frontier_chart(story.rows[result.name])]
    if lines:
        some = [one for key in (lines[0].before, lines[0].after) if (one := result.measurement(*key))]
        before, after = (one.map_runs[0].outcomes for one in some)
        reduced = opened.maps.get("dominating", opened.maps["full"])
        places = reference_places(opened.maps["full"], reduced), query_places(result.queries, before, after)
        figures += [sphere_chart(result.box, *places), reliability_chart(some[1].outcomes)]
    return _charts(figures)


def _charts(figures: Sequence[Figure]) -> str:
    drawn = "\n".join(
        f'<div class="chart" style="--width: {_CSS_PX * one.get_figwidth():.0f}px">{figure_svg(one)}</div>'
        for one in figures
    )
    return f'<div class="charts">\n{drawn}\n</div>'
