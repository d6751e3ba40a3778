"""Signatures become command lines: names, values, defaults, groups and texts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest

from slimsfm.cli.options import Advanced, Argument, Command, Flags, Positional, Prefixed, Typed, options_of
from slimsfm.cli.parsing import help_of, parse, with_flags
from slimsfm.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Inner:
    """Options in options."""

    seed: int = 0
    """Seed of every
    random choice."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class Outer:
    """Options."""

    kind: Literal["one", "two"] = "one"
    """Which of them."""

    inner: Inner = Inner(seed=3)
    """Further options."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A source with a required field."""

    path: Path
    """Where it is."""

    step: float | None = None
    """Every n-th of it."""


calls: list[tuple] = []


def work(
    name: Annotated[str, Argument("NAME")],
    /,
    source: Annotated[Source, Positional],
    output: Annotated[Path, Flags(("-o", "--output"))],
    outer: Annotated[Outer, Advanced(("inner",))] = Outer(),
    other: Annotated[Inner, Prefixed, Advanced()] = Inner(),
    sizes: tuple[int, ...] = (1, 2),
    fast: bool = False,
    *,
    typed: Annotated[str, Typed],
) -> None:
    """Do the work.

    Args:
        name: Its name.
        source: Where it comes from.
        output: Where it
            goes.
        outer: Options.
        other: Other options.
        sizes: Its sizes.
        fast: Hurry.
        typed: The command line.
    """
    calls.append((name, source, output, outer, other, sizes, fast, typed))


COMMAND = Command(work)


def call(*arguments: str) -> tuple:
    parse(COMMAND, "work", arguments)()
    return calls.pop()


def test_values_reach_the_parameters_and_the_rest_keeps_its_defaults():
    given = call("a", "b", "-o", "c", "--seed", "7", "--other.seed=8", "--sizes", "5", "6", "--fast")
    typed = "slimsfm work a b -o c --seed 7 --other.seed=8 --sizes 5 6 --fast"
    expected = ("a", Source(path=Path("b")), Path("c"), Outer(inner=Inner(seed=7)), Inner(seed=8))
    assert given == (*expected, (5, 6), True, typed)
    assert call("a", "b", "-o", "c")[3:7] == (Outer(), Inner(), (1, 2), False)
    assert call("a", "b", "-o", "c", "--kind", "two", "--step", "0.5")[1].step == 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a", "b"), "the following arguments are required: -o/--output"),
        (("a", "b", "-o", "c", "--sizes", "x"), "--sizes: invalid int value: 'x'"),
        (("a", "b", "-o", "c", "--kind", "x"), "--kind: invalid choice: 'x'"),
        (("a", "b", "-o", "c", "--seed", "-1"), "seed must not be negative, got -1"),
        (("a", "b", "-o", "c", "--sed", "1"), "--sed is not an option; did you mean --seed?"),
        (("a", "b", "c", "-o", "d"), "unrecognized arguments: c"),
    ],
    ids=str,
)
def test_errors_name_the_argument_and_the_help(arguments, message):
    with pytest.raises(InputError, match=r"; see slimsfm work --help$") as error:
        parse(COMMAND, "work", arguments)
    assert str(error.value).startswith(message)


def test_options_say_what_they_mean_and_what_they_are_by_default():
    found = {option.flags or (option.metavar,): option for option in options_of(COMMAND)}
    assert list(found)[:2] == [("NAME",), ("PATH",)]
    assert found["--seed",].help == "Seed of every random choice."
    assert found["--seed",].default_text == "3"
    assert found["-o", "--output"].help == "Where it goes."
    assert found["--sizes",].default_text == "1 2"
    assert [flags for flags, one in found.items() if one.is_advanced] == [("--seed",), ("--other.seed",)]


def test_the_help_fits_the_terminal_and_shows_no_none(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    said = help_of(COMMAND, "work")
    assert said.startswith("usage: slimsfm work NAME PATH -o PATH [OPTIONS]\n\nDo the work.\n\narguments:\n")
    assert max(map(len, said.splitlines())) <= 60
    assert "None" not in said
    assert said.index("--fast") < said.index("\nadvanced:\n") < said.index("--other.seed N")


@pytest.mark.parametrize(
    ("message", "written"),
    [
        ("pass `overwrite=True`", "pass --overwrite"),
        ("use `edges='tracks'` or more", "use --edges tracks or more"),
        ("`query_every=1` leaves 0", "--query-every 1 leaves 0"),
        ("give `camera=FILE`", "give --camera FILE"),
        ("by `slimsfm info MAP`", "by `slimsfm info MAP`"),
    ],
)
def test_options_in_messages_become_flags(message, written):
    assert with_flags(message) == written
