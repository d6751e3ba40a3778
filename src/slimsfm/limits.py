"""Limits on what is read, so that a small file cannot fill the memory: sizes are checked before unpacking."""

import os
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cache
from math import ceil, isfinite
from pathlib import Path

from slimsfm.errors import ImageError, InputError

MEGAPIXELS = "SLIMSFM_MAX_MEGAPIXELS"
"""Environment variable with the user's default of `Limits.max_megapixels`."""

FILE_GB = "SLIMSFM_MAX_FILE_GB"
"""Environment variable with the user's default of `Limits.max_file_gb`."""

_GB, _MEGAPIXEL = 1e9, 1e6


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The largest images and files that are read."""

    max_megapixels: float | int = 120.0
    """Pixels of an image or of a frame of a video, in millions. Reading as many takes a gigabyte of memory,
    two if they have 16 bits."""

    max_file_gb: float | int = 2.0
    """Unpacked size of a file that is read as a whole, or of an array in one, in gigabytes."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive number, got {value}")

    @classmethod
    def from_environment(cls, max_megapixels: float | int | None = None) -> "Limits":
        """The user's defaults, from the environment variables, for what is not given.

        Raises:
            InputError: A value is not a positive number.
        """
        found = {"max_megapixels": _from_variable(MEGAPIXELS) if max_megapixels is None else max_megapixels}
        found["max_file_gb"] = _from_variable(FILE_GB)
        try:
            return cls(**{name: value for name, value in found.items() if value is not None})
        except ValueError as error:
            raise InputError(str(error)) from error


def _from_variable(name: str) -> float | None:
    text = os.environ.get(name)
    try:
        return float(text) if text else None
    except ValueError as error:
        raise InputError(
            f"the environment variable {name} must be a positive number, got {text!r}"
        ) from error


_used: Limits | None = None


def use_limits(limits: Limits | None) -> AbstractContextManager:
    """Use limits for all files that this process reads from now on, on any thread.

    Args:
        limits: None: the user's defaults.

    Returns:
        A context manager that restores the previous limits at its end; it may be ignored.
    """
    global _used
    restoring = ExitStack()
    restoring.callback(_restore, _used)
    _used = limits
    return restoring


def _restore(limits: Limits | None) -> None:
    global _used
    _used = limits


def chosen_limits() -> Limits | None:
    """The limits of the last `use_limits`; None: the user's defaults. Passed on to worker processes."""
    return _used


def current_limits() -> Limits:
    """The limits in use.

    Raises:
        InputError: An environment variable with a default is not a positive number.
    """
    return _used or _defaults(os.environ.get(MEGAPIXELS), os.environ.get(FILE_GB))


@cache
def _defaults(_megapixels: str | None, _file_gb: str | None) -> Limits:
    """The user's defaults, computed once, because they are asked for at each array."""
    return Limits.from_environment()


def check_pixels(source: Path | str, width: int, height: int) -> None:
    """Check the size of an image before its pixels are decoded.

    Args:
        source: What the image is, for the message.
        width: Width in pixels.
        height: Height in pixels.

    Raises:
        ImageError: The image has more pixels than the limit.
    """
    has, most = width * height / _MEGAPIXEL, current_limits().max_megapixels
    if has > most:
        raise ImageError(
            f"{source}: has {has:.4g} megapixels, more than the limit of {most:g}; shrink it or pass "
            f"`max_megapixels={ceil(has)}` (environment variable {MEGAPIXELS})"
        )


def check_bytes(source: Path | str, num_bytes: int) -> None:
    """Check a size before a file or an array is read into memory.

    Args:
        source: What is read, for the message.
        num_bytes: Its size in memory.

    Raises:
        InputError: It is larger than the limit.
    """
    most = current_limits().max_file_gb
    if num_bytes > most * _GB:
        raise InputError(
            f"{source}: takes {num_bytes / _GB:.3g} GB of memory, more than the limit of {most:g} GB; if "
            f"that is right, set the environment variable {FILE_GB}"
        )
