"""Localizing query images against a map: load once, localize many."""

from slimsfm.localization.localizer import STRATEGIES, Localization, LocalizationOptions, Localizer, Seconds
from slimsfm.localization.multi import MultiLocalizer

__all__ = ["STRATEGIES", "Localization", "LocalizationOptions", "Localizer", "MultiLocalizer", "Seconds"]
