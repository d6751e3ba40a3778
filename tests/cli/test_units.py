"""Amounts with units."""

import pytest

from slimsfm.cli.reduce_command import parse_bytes, parse_percent
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


@pytest.mark.parametrize("text", ["", "%", "1 kB", "-1%", "one"])
def test_invalid_percentages(text):
    with pytest.raises(InputError, match="max-loss must be a percentage such as 1%, got"):
        parse_percent(text, "max-loss")
