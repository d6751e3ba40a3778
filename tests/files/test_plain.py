from dataclasses import dataclass
from typing import Any, Literal

import pytest

from slimsfm.files import plain


@dataclass(frozen=True)
class Part:
    count: int
    share: float = 0.5


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (3, int, 3),
        (3, float, 3.0),
        ("ä", str, "ä"),
        (True, bool, True),
        (None, str | None, None),
        ("a", str | None, "a"),
        ("full", Literal["full", "part"], "full"),
        ([1, 2], tuple[int, ...], (1, 2)),
        ([[1], [2.5]], list[list[float]], [[1.0], [2.5]]),
        ({"a": [1]}, dict[str, list[int]], {"a": [1]}),
        ({"count": 2, "later": "x"}, Part, Part(2)),
        ({"count": 2, "share": 1}, Part | None, Part(2, 1.0)),
        ([{}], Any, [{}]),
    ],
)
def test_a_value_of_the_type_comes_back(value, hint, expected):
    found = plain(value, hint)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        (True, int),
        (True, float),
        (1.0, int),
        (2**60, int),
        ("1", int),
        (float("nan"), float),
        (float("inf"), float),
        (1e300, float),
        (1, str),
        ("\ud800", str),
        (0, bool),
        (None, str),
        ([], str | None),
        ("none", Literal["full", "part"]),
        ("ab", tuple[str, ...]),
        ([[1], 2], list[list[float]]),
        ([], dict[str, int]),
        ({"a": "b"}, dict[str, int]),
        ([], Part),
        ({}, Part),
        ({"count": "2"}, Part),
    ],
)
def test_a_value_of_another_type_is_refused(value, hint):
    with pytest.raises((ValueError, KeyError)):
        plain(value, hint)
