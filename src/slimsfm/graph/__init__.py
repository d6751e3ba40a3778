"""The reference graph: which reference image localizes which other one."""

from slimsfm.graph.localize import GraphOptions, localize_pairs
from slimsfm.graph.reference_graph import ReferenceGraph

__all__ = ["GraphOptions", "ReferenceGraph", "localize_pairs"]
