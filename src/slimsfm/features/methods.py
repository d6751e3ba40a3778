"""The extractors by name."""

from importlib import import_module

from slimsfm.errors import InputError
from slimsfm.features.base import Extractor

# Paths, not classes: naming a method must not import what it needs.
EXTRACTORS = {
    "sift": "slimsfm.features.sift:Sift",
}


def load_extractor(name: str, options: dict | None = None) -> Extractor:
    """Make the extractor of this name.

    Raises:
        InputError: No extractor has this name, or it knows no such options.
    """
    if name not in EXTRACTORS:
        raise InputError(f"extractor {name!r} is unknown; known are {', '.join(sorted(EXTRACTORS))}")
    module, attribute = EXTRACTORS[name].split(":")
    try:
        return getattr(import_module(module), attribute)(**(options or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"extractor {name!r}: {error}") from error
