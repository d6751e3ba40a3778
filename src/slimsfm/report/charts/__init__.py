"""Figures of maps and benchmarks, drawn by matplotlib; import it where a figure is drawn, not before."""

from slimsfm.report.charts.cloud import before_after_figure, cloud_figure
from slimsfm.report.charts.directions import QueryPlace, ReferencePlace, query_places, reference_places
from slimsfm.report.charts.frontier import frontier_chart
from slimsfm.report.charts.graph import graph_figure
from slimsfm.report.charts.reliability import reliability_chart
from slimsfm.report.charts.sphere import sphere_chart

__all__ = [
    "QueryPlace",
    "ReferencePlace",
    "before_after_figure",
    "cloud_figure",
    "frontier_chart",
    "graph_figure",
    "query_places",
    "reference_places",
    "reliability_chart",
    "sphere_chart",
]
