"""Localize query images against a map: load the map once, localize many images."""

from slimsfm.localization.batch import MultiLocalizer, localize_images, localize_objects
from slimsfm.localization.fallback import check_same_frame, localize_failed
from slimsfm.localization.localizer import Localizer
from slimsfm.localization.options import STRATEGIES, LocalizationOptions
from slimsfm.localization.outcome import Localization, Seconds

__all__ = [
    "STRATEGIES",
    "Localization",
    "LocalizationOptions",
    "Localizer",
    "MultiLocalizer",
    "Seconds",
    "check_same_frame",
    "localize_failed",
    "localize_images",
    "localize_objects",
]
