"""Local features: what an extractor gives, and the extractors there are."""

from slimsfm.features.base import Extractor, Features, image_colors, unit_rows
from slimsfm.features.methods import EXTRACTORS, load_extractor
from slimsfm.features.nearest import NearestOptions, match_nearest

__all__ = [
    "EXTRACTORS",
    "Extractor",
    "Features",
    "NearestOptions",
    "image_colors",
    "load_extractor",
    "match_nearest",
    "unit_rows",
]
