"""The help of every command, asked of the program itself when the site is built: it cannot go stale."""

import os
import re
import textwrap
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import Any
from unittest.mock import patch

PLACE = "<!-- the help of every command is put here -->"

_WIDTH = 80
_ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_KIND = re.compile(r"more:\s+slimsfm\s+\w+\s+(\S+)\s+--help")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the page that has the place for it."""
    return markdown.replace(PLACE, "\n".join(_sections())) if PLACE in markdown else markdown


def help_of(*command: str) -> str:
    """What a command says with --help: plain text in lines of 80 characters.

    Raises:
        RuntimeError: It fails.
    """
    from slimsfm.cli import run

    with (
        patch.dict(os.environ, COLUMNS=str(_WIDTH), NO_COLOR="1"),
        redirect_stdout(StringIO()) as said,
        redirect_stderr(StringIO()) as error,
    ):
        code = run([*command, "--help"])
    if code:
        raise RuntimeError(f"slimsfm {' '.join(command)} --help fails: {error.getvalue()}")
    lines = _ANSI.sub("", said.getvalue()).splitlines()
    return "\n".join(textwrap.fill(line, _WIDTH) if len(line) > _WIDTH else line.rstrip() for line in lines)


def _sections() -> Iterator[str]:
    from slimsfm.cli import COMMANDS

    for name, what in COMMANDS.items():
        said = help_of(name)
        yield f"## {name}\n\n{what[0].upper()}{what[1:]}.\n\n```text\n{said}\n```\n"
        for kind in _kinds(said):
            folded = textwrap.indent(f"```text\n{help_of(name, kind)}\n```", "    ")
            yield f'### {name} {kind}\n\n??? info "`slimsfm {name} {kind} --help`"\n\n{folded}\n'


def _kinds(said: str) -> Iterator[str]:
    """What a command's help says that there is more help for."""
    from slimsfm.datasets import DATASETS

    for kind in _KIND.findall(said):
        yield from DATASETS if kind == "DATASET" else [kind]
