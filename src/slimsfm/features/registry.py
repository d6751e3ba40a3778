"""Extractors, matchers and ONNX exports by name.

Entries hold import paths, not classes: naming a method does not import what the method needs.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_type_hints

from slimsfm.errors import InputError
from slimsfm.features.base import Extractor, Matcher, NearestOptions
from slimsfm.files import plain, replacing
from slimsfm.threads import waiting_without_spinning


@dataclass(frozen=True, kw_only=True)
class ExtractorEntry:
    """An extractor and what the rest of the program must know about its features."""

    path: str
    """Import path `MODULE:CLASS`."""

    descriptor_metric: NearestOptions = NearestOptions()
    """How descriptors compare: which nearest neighbors count as matches."""

    has_keypoints: bool = True
    """Whether the extractor finds keypoints; otherwise images are matched as a whole."""

    descriptor_length: int | None = None
    """Number of values of a descriptor; None if unknown."""

    signed: bool | None = None
    """Whether descriptors have negative values; None if unknown."""


EXTRACTORS = {
    "aliked": ExtractorEntry(
        path="slimsfm.methods.aliked:Aliked",
        descriptor_metric=NearestOptions(max_ratio=0.95, max_distance=0.9),
        descriptor_length=128,
        signed=True,
    ),
    "disk": ExtractorEntry(
        path="slimsfm.methods.disk:Disk",
        descriptor_metric=NearestOptions(max_ratio=0.95, max_distance=0.9),
        descriptor_length=128,
        signed=True,
    ),
    "loftr": ExtractorEntry(path="slimsfm.methods.loftr.extractor:DetectorFree", has_keypoints=False),
    "sift": ExtractorEntry(path="slimsfm.features.sift:Sift", descriptor_length=128, signed=False),
    "superpoint": ExtractorEntry(
        path="slimsfm.methods.superpoint:SuperPoint",
        descriptor_metric=NearestOptions(max_ratio=0.95, max_distance=0.8),
        descriptor_length=256,
        signed=True,
    ),
    "xfeat": ExtractorEntry(
        path="slimsfm.methods.xfeat:XFeat",
        descriptor_metric=NearestOptions(max_ratio=0.98, max_distance=0.7),
        descriptor_length=64,
        signed=True,
    ),
}
"""Built-in extractors. The class of a plug-in may have attributes named as the fields of `ExtractorEntry`."""

MATCHERS = {
    "lighterglue": "slimsfm.methods.lighterglue:LighterGlue",
    "lightglue": "slimsfm.methods.lightglue:LightGlue",
    "nearest": "slimsfm.features.nearest:Nearest",
    "superglue": "slimsfm.methods.superglue:SuperGlue",
}
"""Import paths of the built-in matchers."""

_ON_ONE_CORE = {"nearest", "sift"}

EXPORTABLE = {
    "aliked-n16": "slimsfm.methods.aliked:exportable",
    "aliked-t16": "slimsfm.methods.aliked:exportable",
    "disk": "slimsfm.methods.disk:exportable",
    "lighterglue": "slimsfm.methods.lighterglue:exportable",
    "lightglue-aliked": "slimsfm.methods.lightglue:exportable",
    "lightglue-disk": "slimsfm.methods.lightglue:exportable",
    "lightglue-sift": "slimsfm.methods.lightglue:exportable",
    "lightglue-superpoint": "slimsfm.methods.lightglue:exportable",
    "superpoint": "slimsfm.methods.superpoint:exportable",
    "xfeat": "slimsfm.methods.xfeat_network:exportable",
}
"""Functions that return the exportable part of a network, by the name of the network's weights."""

_GROUPS = {
    "extractor": "slimsfm.extractors",
    "matcher": "slimsfm.matchers",
    "strategy": "slimsfm.strategies",
}  # entry points through which installed packages offer their own methods


def load_extractor(name: str, options: dict | None = None) -> Extractor:
    """Create an extractor.

    Raises:
        InputError: The name or an option is unknown, or a package that the extractor needs is missing.
    """
    return load_method("extractor", {key: one.path for key, one in EXTRACTORS.items()}, name, options)


def load_matcher(name: str, features: str) -> Matcher:
    """Create a matcher for the features of an extractor.

    Raises:
        InputError: The name is unknown, the matcher does not support these features, or a package that it
            needs is missing.
    """
    return load_method("matcher", MATCHERS, name, {"features": features})


def runs_on_one_core(method: str) -> bool:
    """Whether an extractor or a matcher needs one core, so that several processes share its work.

    Networks use all cores, or the GPU, in one process, and their results may depend on the number of threads.
    """
    return method in _ON_ONE_CORE


def descriptor_metric_of(extractor: str) -> NearestOptions:
    """How the descriptors of an extractor compare; SIFT's thresholds if the extractor states none."""
    return _entry(extractor).descriptor_metric


def finds_keypoints(extractor: str) -> bool:
    """Whether an extractor finds keypoints; otherwise images are matched as a whole."""
    return _entry(extractor).has_keypoints


def extractor_entry(extractor: str) -> ExtractorEntry:
    """What is known about an extractor.

    Raises:
        InputError: The name is unknown, or a package that a plug-in needs is missing.
    """
    _check_known("extractor", extractor, EXTRACTORS)
    return _entry(extractor)


def _entry(extractor: str) -> ExtractorEntry:
    if extractor in EXTRACTORS:
        return EXTRACTORS[extractor]
    path = plugins("extractor").get(extractor)
    if path is None:  # a map whose plug-in is not installed can still be read
        return ExtractorEntry(path="")
    with importing(f"extractor {extractor!r}"):
        plugin = load_object(path)
    facts = ("descriptor_metric", "has_keypoints", "descriptor_length", "signed")
    stated = {key: getattr(plugin, key) for key in facts if hasattr(plugin, key)}
    return ExtractorEntry(path=path, **stated)


def load_method(kind: str, registry: dict[str, str], name: str, options: dict | None = None) -> Any:
    """Create a built-in method or a plug-in.

    Args:
        kind: extractor, matcher or strategy.
        registry: Import paths of the built-in methods by name.
        name: Name of the method.
        options: Keyword arguments of the method's class.

    Raises:
        InputError: The name or an option is unknown, or a package that the method needs is missing.
    """
    _check_known(kind, name, registry)
    known = {**plugins(kind), **registry}
    try:
        with importing(f"{kind} {name!r}"):
            made = load_object(known[name])
        _check_types(made, options or {})
        with importing(f"{kind} {name!r}"):
            return made(**(options or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"{kind} {name!r}: {error}") from error


def _check_types(kind: Any, options: dict) -> None:
    """Check options, which may come from a file, against the fields of a dataclass."""
    hints = get_type_hints(kind) if is_dataclass(kind) else {}
    for name, value in options.items():
        try:
            plain(value, hints.get(name, Any))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error


def _check_known(kind: str, name: str, builtin: Collection[str]) -> None:
    known = {*plugins(kind), *builtin}
    if name not in known:
        raise InputError(f"{kind} {name!r} is unknown; known are {', '.join(sorted(known))}")


def export_method(method: str, path: Path, *, overwrite: bool = False) -> None:
    """Write the network of a method, with its trained weights, as an ONNX file.

    The file holds the static graph of tensors that takes most of the time: for an extractor the convolutions
    without the keypoint selection, for LightGlue everything but early stopping.

    Raises:
        InputError: The method cannot be exported, or its weights or a package are missing.
        OutputError: The file cannot be written.
    """
    if method not in EXPORTABLE:
        known = ", ".join(EXPORTABLE)
        raise InputError(f"{method!r} cannot be exported; exportable methods are {known}")
    with importing(f"method {method!r}"):
        make = load_object(EXPORTABLE[method])
        write_onnx = load_object("slimsfm.networks.onnx:write_onnx")
    part = make(method)
    with replacing(path, overwrite=overwrite) as partial:
        write_onnx(part, method, partial)


@contextmanager
def importing(what: str) -> Iterator[None]:
    """Turn a missing package into an error that names the extra to install; threads of packages do not spin.

    Raises:
        InputError: A package is missing.
    """
    try:
        with waiting_without_spinning():
            yield
    except ModuleNotFoundError as error:
        raise InputError(
            f"{what} needs {error.name}, which is not installed: pip install 'slimsfm[learned]'"
        ) from error


@cache
def plugins(kind: str) -> dict[str, str]:
    """Import paths of the methods of this kind in installed packages, by name."""
    return {found.name: found.value for found in entry_points(group=_GROUPS[kind])}


def load_object(path: str) -> Any:
    """Import the object at `MODULE:NAME`."""
    module, attribute = path.split(":")
    return getattr(import_module(module), attribute)
