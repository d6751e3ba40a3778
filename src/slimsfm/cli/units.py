"""Amounts with their units, as a user writes them."""

import re

from slimsfm.errors import InputError

_BYTES = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30}


def parse_bytes(text: str, argument: str) -> float:
    """Read a size such as 100kB, 1.5 MB or 2MiB.

    Raises:
        InputError: It is none.
    """
    return _parse(text, argument, _BYTES, "a size such as 100kB or 2MB")


def parse_percent(text: str, argument: str) -> float:
    """Read a percentage, with or without its sign.

    Raises:
        InputError: It is none.
    """
    return _parse(text, argument, {"": 1.0, "%": 1.0}, "a percentage such as 1%")


def _parse(text: str, argument: str, units: dict[str, float], example: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z%]*)\s*", text)
    if match is None or match[2].lower() not in units:
        raise InputError(f"{argument} must be {example}, got {text!r}")
    return float(match[1]) * units[match[2].lower()]
