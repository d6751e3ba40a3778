"""Local features: what extractors and matchers give, and which there are."""

from slimsfm.features.base import Extractor, Features, Matcher, image_colors, unit_rows
from slimsfm.features.methods import EXTRACTORS, MATCHERS, load_extractor, load_matcher
from slimsfm.features.nearest import NearestOptions, match_nearest, nearest_for

__all__ = [
    "EXTRACTORS",
    "MATCHERS",
    "Extractor",
    "Features",
    "Matcher",
    "NearestOptions",
    "image_colors",
    "load_extractor",
    "load_matcher",
    "match_nearest",
    "nearest_for",
    "unit_rows",
]
