"""The reference graph: which reference image localizes which other one."""

from slimsfm.graph.compute import GraphRun, GraphWork, compute_graph
from slimsfm.graph.reference_graph import ReferenceGraph
from slimsfm.graph.source import EDGE_SOURCES, EdgeSource, GraphOptions, PairErrors

__all__ = [
    "EDGE_SOURCES",
    "EdgeSource",
    "GraphOptions",
    "GraphRun",
    "GraphWork",
    "PairErrors",
    "ReferenceGraph",
    "compute_graph",
]
