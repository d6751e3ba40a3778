"""Names of files are printed as they are: neither markup nor emoji nor commands to the terminal."""

from io import StringIO

import pytest
from rich.console import Console
from rich.table import Table

from commands import slimsfm
from slimsfm.cli.output import console
from slimsfm.progress import TerminalBars

NAMES = [
    "IMG [edited].jpg",
    "a[/b].jpg",
    "[/red]",
    "[bold]x[/bold]",
    ":car:.jpg",
    "\\[x]",
    "[link=x]y",
    "ä 日本.jpg",
]


@pytest.mark.parametrize("name", NAMES)
def test_names_are_printed_whole(name):
    table = Table(title=name)
    table.add_column(name)
    table.add_row(name)
    with console.capture() as captured:
        console.print(name, style="bold red")
        console.print(table)
    assert captured.get().count(name) == 4


@pytest.mark.parametrize("name", NAMES)
def test_names_in_bars_are_printed_whole(name):
    out = StringIO()
    bars = TerminalBars(Console(file=out, force_terminal=True, width=120))
    assert list(bars([1, 2], name)) == [1, 2]
    assert name in out.getvalue()


@pytest.mark.parametrize("name", NAMES)
def test_names_in_errors_are_printed_whole(name):
    assert f"slimsfm: {name}: not a map" in slimsfm("info", name).err


def test_commands_to_the_terminal_are_escaped():
    name = "a\x1b[31m\x9b2J\u202eb\x07"
    shown = r"a\x1b[31m\x9b2J\u202eb\x07"
    assert shown in slimsfm("info", name).err
    with console.capture() as captured:
        console.print(name)
    assert captured.get() == f"{shown}\n"
