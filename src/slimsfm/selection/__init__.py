"""Which 3D points of a map to keep: one method a file behind one protocol."""

from slimsfm.selection.information import information
from slimsfm.selection.kcover import kcover
from slimsfm.selection.probabilistic import probabilistic
from slimsfm.selection.problem import ImagesOfPoints, SelectionProblem, Selector
from slimsfm.selection.random_points import random_points

SELECTORS: dict[str, Selector] = {
    "information": information,
    "kcover": kcover,
    "probabilistic": probabilistic,
    "random": random_points,
}

__all__ = [
    "SELECTORS",
    "ImagesOfPoints",
    "SelectionProblem",
    "Selector",
    "information",
    "kcover",
    "probabilistic",
    "random_points",
]
