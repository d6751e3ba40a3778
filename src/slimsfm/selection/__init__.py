"""Which 3D points of a map to keep: selectors behind one protocol."""

from slimsfm.selection.problem import ImagesOfPoints, SelectionProblem, Selector
from slimsfm.selection.selectors import information, kcover, random_points

SELECTORS: dict[str, Selector] = {
    "information": information,
    "kcover": kcover,
    "random": random_points,
}

REPLACED_SELECTORS = {"probabilistic": "kcover"}
"""Names of removed selectors that are still accepted, and the selectors that are used instead."""


def current_selector(name: str) -> str:
    """Return the name of a selector, or that of the selector which replaces a removed one.

    Raises:
        ValueError: There is no selector of this name.
    """
    current = REPLACED_SELECTORS.get(name, name)
    if current not in SELECTORS:
        raise ValueError(f"selector must be one of {', '.join(SELECTORS)}, got {name!r}")
    return current


__all__ = [
    "REPLACED_SELECTORS",
    "SELECTORS",
    "ImagesOfPoints",
    "SelectionProblem",
    "Selector",
    "current_selector",
    "information",
    "kcover",
    "random_points",
]
