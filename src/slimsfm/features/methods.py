"""The extractors and matchers by name."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from slimsfm.errors import InputError
from slimsfm.features.base import Extractor, Matcher

# Paths, not classes: naming a method must not import what it needs.
EXTRACTORS = {
    "aliked": "slimsfm.features.aliked:Aliked",
    "disk": "slimsfm.features.disk:Disk",
    "loftr": "slimsfm.features.detector_free:DetectorFree",
    "sift": "slimsfm.features.sift:Sift",
    "superpoint": "slimsfm.features.superpoint:SuperPoint",
}

MATCHERS = {
    "lightglue": "slimsfm.features.lightglue:LightGlue",
    "nearest": "slimsfm.features.nearest:Nearest",
    "superglue": "slimsfm.features.superglue:SuperGlue",
}

_GROUPS = {
    "extractor": "slimsfm.extractors",
    "matcher": "slimsfm.matchers",
    "strategy": "slimsfm.strategies",
}  # entry points, by which installed packages offer methods of their own

DETECTOR_FREE = {"loftr"}
"""Extractors that find no keypoints: images are matched as wholes."""


def load_extractor(name: str, options: dict | None = None) -> Extractor:
    """Make the extractor of this name.

    Raises:
        InputError: No extractor has this name, it knows no such options, or what it needs is missing.
    """
    return load_method("extractor", EXTRACTORS, name, options)


def load_matcher(name: str, features: str) -> Matcher:
    """Make the matcher of this name for the features of an extractor.

    Raises:
        InputError: No matcher has this name, it cannot match such features, or what it needs is missing.
    """
    return load_method("matcher", MATCHERS, name, {"features": features})


def load_method(kind: str, registry: dict[str, str], name: str, options: dict | None = None) -> Any:
    """Make the method of this name, one of ours or a plug-in's.

    Args:
        kind: extractor, matcher or strategy.
        registry: Our methods' import paths by name.
        name: The method's name.
        options: Its options.

    Raises:
        InputError: Nothing has this name, it knows no such options, or what it needs is missing.
    """
    known = {**plugins(kind), **registry}
    if name not in known:
        raise InputError(f"{kind} {name!r} is unknown; known are {', '.join(sorted(known))}")
    try:
        with importing(f"{kind} {name!r}"):
            return resolve(known[name])(**(options or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"{kind} {name!r}: {error}") from error


@contextmanager
def importing(what: str) -> Iterator[None]:
    """Say which extra to install where a package is missing.

    Raises:
        InputError: A package is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(
            f"{what} needs {error.name}, which is not installed: pip install 'slimsfm[learned]'"
        ) from error


@cache
def plugins(kind: str) -> dict[str, str]:
    """Import paths of what installed packages offer, by name."""
    return {found.name: found.value for found in entry_points(group=_GROUPS[kind])}


def resolve(path: str) -> Any:
    """What an import path `MODULE:NAME` names."""
    module, attribute = path.split(":")
    return getattr(import_module(module), attribute)
