"""Amounts with units."""

import pytest

from slimsfm.cli.reduce_command import parse_bytes, parse_length, parse_percent
from slimsfm.errors import InputError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("100", 100),
        ("100B", 100),
        ("100kB", 1e5),
        ("100 KB", 1e5),
        ("1.5 MB", 1.5e6),
        (".5GB", 5e8),
        ("2MiB", 2 * 2**20),
        ("1.kib", 1024),
        (" 3 gib ", 3 * 2**30),
        ("0", 0),
    ],
)
def test_sizes(text, value):
    assert parse_bytes(text, "max-bytes") == value


@pytest.mark.parametrize(("text", "value"), [("1%", 1), ("0.5 %", 0.5), ("2", 2), ("100%", 100)])
def test_percentages(text, value):
    assert parse_percent(text, "max-loss") == value


@pytest.mark.parametrize(
    "text", ["", "kB", "12 parsecs", "-1", "1e3", "1,5 MB", "nan", "inf", "1 %", "1.2.3", "."]
)
def test_invalid_sizes(text):
    with pytest.raises(InputError, match="max-bytes must be a size such as 100kB or 2MB, got"):
        parse_bytes(text, "max-bytes")


@pytest.mark.parametrize(
    ("text", "lengths"),
    [("0.05", (0.05, None)), ("0.01d", (None, 0.01)), (" 2 D ", (None, 2.0)), ("0", (0.0, None))],
)
def test_lengths_are_in_map_units_or_diagonals(text, lengths):
    assert parse_length(text, "max-error") == lengths


@pytest.mark.parametrize("text", ["", "d", "1 cm", "-1d", "nan"])
def test_invalid_lengths(text):
    with pytest.raises(InputError, match=r"max-error must be a length such as 0\.05 or 0\.01d, got"):
        parse_length(text, "max-error")


@pytest.mark.parametrize("text", ["", "%", "1 kB", "-1%", "one"])
def test_invalid_percentages(text):
    with pytest.raises(InputError, match="max-loss must be a percentage such as 1%, got"):
        parse_percent(text, "max-loss")
