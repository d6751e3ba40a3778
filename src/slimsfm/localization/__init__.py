"""Localize query images against a map: load the map once, localize many images."""

from slimsfm.localization.batch import localize_images, localize_objects
from slimsfm.localization.localizer import STRATEGIES, Localization, LocalizationOptions, Localizer, Seconds
from slimsfm.localization.multi import MultiLocalizer

__all__ = [
    "STRATEGIES",
    "Localization",
    "LocalizationOptions",
    "Localizer",
    "MultiLocalizer",
    "Seconds",
    "localize_images",
    "localize_objects",
]
