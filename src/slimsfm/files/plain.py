"""Plain values from files, such as JSON's, as the types that a program expects."""

from dataclasses import MISSING, fields, is_dataclass
from math import isfinite
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_LARGEST = 1e30  # number: sums and products of such stay finite


def plain(value: Any, hint: Any) -> Any:
    """Convert a plain value to a type, so that nothing fails later because of it.

    Args:
        value: As `json.loads` gives it.
        hint: Any, bool, int, float, str, None, a `Literal`, `tuple[X, ...]`, `list[X]`, `dict[str, X]`, or a
            dataclass of these; each may be optional. Keys that a dataclass does not have are ignored, because
            later versions may write more.

    Returns:
        The value, its numbers finite.

    Raises:
        ValueError: It is not of this type.
        KeyError: A field of a dataclass is missing.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        return _plain_union(value, arguments)
    if origin is Literal and value in arguments:
        return value
    if origin in (tuple, list) and isinstance(value, list | tuple):
        return origin(plain(one, arguments[0]) for one in value)
    if origin is dict and isinstance(value, dict):
        return {plain(key, arguments[0]): plain(one, arguments[1]) for key, one in value.items()}
    if is_dataclass(hint) and isinstance(value, dict):
        return _plain_dataclass(value, hint)
    if _is_simple(value, hint):
        return float(value) if hint is float else value
    expected = (
        f"one of {', '.join(map(str, arguments))}" if origin is Literal else getattr(hint, "__name__", hint)
    )
    raise ValueError(f"{str(value)[:50]!r} is not {expected}")


def _plain_union(value: Any, hints: tuple[Any, ...]) -> Any:
    if value is None and NoneType in hints:
        return None
    return plain(value, next(one for one in hints if one is not NoneType))


def _plain_dataclass(value: dict, kind: Any) -> Any:
    hints = get_type_hints(kind)
    found = {}
    for one in fields(kind):
        if one.name in value:
            found[one.name] = plain(value[one.name], hints[one.name])
        elif one.default is MISSING and one.default_factory is MISSING:
            raise KeyError(one.name)
    return kind(**found)


def _is_simple(value: Any, hint: Any) -> bool:
    if hint is str:
        return isinstance(value, str) and value.encode() is not None  # raises for halves of surrogate pairs
    if hint is float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and isfinite(value) and abs(value) < _LARGEST
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
    return hint in (bool, None, NoneType) and isinstance(value, bool if hint is bool else NoneType)
