"""Local features: data types, extractors, matchers and descriptor matching."""

from slimsfm.features.base import (
    BatchMatcher,
    Extractor,
    Features,
    Matcher,
    NearestOptions,
    image_colors,
    match_many,
    shrink_factor,
    unit_rows,
    unmasked,
)
from slimsfm.features.nearest import match_nearest
from slimsfm.features.registry import EXTRACTORS, MATCHERS, load_extractor, load_matcher, runs_on_one_core

__all__ = [
    "EXTRACTORS",
    "MATCHERS",
    "BatchMatcher",
    "Extractor",
    "Features",
    "Matcher",
    "NearestOptions",
    "image_colors",
    "load_extractor",
    "load_matcher",
    "match_many",
    "match_nearest",
    "runs_on_one_core",
    "shrink_factor",
    "unit_rows",
    "unmasked",
]
