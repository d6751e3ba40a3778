"""Amounts with units, and limits, as a user writes them."""

import re
from dataclasses import dataclass

from slimsfm.errors import InputError
from slimsfm.reduction import ReductionLimits

_BYTES = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30}


@dataclass(frozen=True, kw_only=True)
class LimitArguments:
    """Limits of the reduced map; the smallest choice within them is taken."""

    max_loss: str | None = None
    """Largest loss against the full map in percentage points, such as 1%. By default nothing may be lost, and
    twice as many points as that needs are kept."""

    max_bytes: str | None = None
    """Largest size on disk, such as 100kB."""

    max_ms: float | None = None
    """Longest time of matching and pose per query on this machine, in milliseconds."""

    max_points: int | None = None
    """Largest number of points."""

    max_images: int | None = None
    """Largest number of images, where images are kept."""

    def __post_init__(self) -> None:
        _ = self.limits  # raises on invalid values

    @property
    def limits(self) -> ReductionLimits:
        """The limits in plain numbers."""
        return ReductionLimits(
            max_loss=None if self.max_loss is None else parse_percent(self.max_loss, "max-loss"),
            max_bytes=None if self.max_bytes is None else parse_bytes(self.max_bytes, "max-bytes"),
            max_ms=self.max_ms,
            max_points=self.max_points,
            max_images=self.max_images,
        )


def parse_bytes(text: str, argument: str) -> float:
    """Read a size such as 100kB, 1.5 MB or 2MiB.

    Raises:
        InputError: The text is not a size.
    """
    return _parse(text, argument, _BYTES, "a size such as 100kB or 2MB")


def parse_percent(text: str, argument: str) -> float:
    """Read a percentage, with or without a percent sign.

    Raises:
        InputError: The text is not a percentage.
    """
    return _parse(text, argument, {"": 1.0, "%": 1.0}, "a percentage such as 1%")


def _parse(text: str, argument: str, units: dict[str, float], example: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z%]*)\s*", text)
    if match is None or match[2].lower() not in units:
        raise InputError(f"{argument} must be {example}, got {text!r}")
    return float(match[1]) * units[match[2].lower()]
