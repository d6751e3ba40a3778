"""A reduced map remembers what it was made from and how, so that a larger map can be reduced alike."""

import json
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from slimsfm.errors import InputError
from slimsfm.files import plain
from slimsfm.mapping.info import Parent
from slimsfm.mapping.map import Map
from slimsfm.reduction.reduced import ReduceOptions
from slimsfm.selection import REPLACED_SELECTORS


def with_parent(full: Map, path: Path, output: Path, options: ReduceOptions) -> Map:
    """A full map whose reductions remember it: so the size of a reduced map includes what it remembers.

    Args:
        full: The full map.
        path: Its folder.
        output: Folder that the reduced map will have.
        options: How it will be reduced.
    """
    relative = Path(os.path.relpath(path.absolute(), output.absolute())).as_posix()
    selector = options.selector and REPLACED_SELECTORS.get(options.selector, options.selector)
    values = asdict(replace(options, selector=selector))
    chosen = json.loads(json.dumps(_changed(values, asdict(ReduceOptions())), default=str))
    parent = Parent(path=relative, fingerprint=full.fingerprint, options=chosen)
    return replace(full, info=replace(full.info, parent=parent))


def _changed(values: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """The values that are not the default, of all levels."""
    found = {}
    for name, value in values.items():
        if isinstance(value, dict):
            value = _changed(value, defaults[name])
            if value:
                found[name] = value
        elif value != defaults[name]:
            found[name] = value
    return found


def repeated_options(slim: Map, path: Path, full: Map) -> ReduceOptions:
    """The options that made a reduced map, to reduce a larger map alike.

    Args:
        slim: The reduced map.
        path: Its folder.
        full: The larger map, which has all of its images.

    Raises:
        InputError: The map was not reduced, or by a version that did not remember how, or by a graph of
            another system; or the other map is not a larger one.
    """
    parent = slim.info.parent
    if parent is None:
        raise InputError(
            f"{path}: does not say how it was reduced (it is a full map, or of an older version); give the "
            "options of the reduction"
        )
    if slim.info.extractor != full.info.extractor:
        raise InputError(
            f"{path}: was made from a map of {slim.info.extractor} features, not of {full.info.extractor}"
        )
    if missing := sorted(set(slim.images) - set(full.images)):
        raise InputError(
            f"{path}: was made from another map: {len(missing)} of its images are not in the map that is to "
            f"be reduced, such as {missing[0]}"
        )
    if parent.options.get("image_choice", {}).get("graph"):
        raise InputError(
            f"{path}: was reduced by a graph of another system, which is not that of the larger map; give "
            "the options of the reduction"
        )
    try:
        return plain(parent.options, ReduceOptions)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: the options that it was reduced with cannot be used: {error}") from error
