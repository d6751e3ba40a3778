"""The reference graph: which reference image localizes which other one."""

from slimsfm.graph.compute import GraphWork, compute_graph, load_or_compute_graph
from slimsfm.graph.edge_sources import EDGE_SOURCES, EdgeSource, GraphOptions, PairErrors
from slimsfm.graph.reference_graph import GraphRun, ReferenceGraph

__all__ = [
    "EDGE_SOURCES",
    "EdgeSource",
    "GraphOptions",
    "GraphRun",
    "GraphWork",
    "PairErrors",
    "ReferenceGraph",
    "compute_graph",
    "load_or_compute_graph",
]
