"""From what was typed to a call of a command, and the help of a command as text."""

import re
import shlex
import shutil
import textwrap
from argparse import SUPPRESS, ArgumentParser
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, replace
from difflib import get_close_matches
from functools import partial
from inspect import signature
from typing import Any, Literal, NoReturn, get_args, get_origin

from slimsfm.cli.options import Command, Option, Parameter, Typed, options_of, parameters_of
from slimsfm.errors import InputError

_WIDEST = 100  # of a line of help: longer ones are hard to read
_INDENT = 24


def parse(command: Command, name: str, arguments: Sequence[str]) -> Callable[[], int | None]:
    """Bind a command to what was typed.

    Args:
        command: The command.
        name: How the command line calls it.
        arguments: What stands after the name.

    Raises:
        InputError: An argument is missing, unknown or has a value that its options refuse.
    """
    options, parameters = options_of(command), parameters_of(command)
    try:
        normal = [_with_dashes(word) for word in arguments]
        _check_flags(options, normal)
        found = vars(_parser_of(options).parse_args(normal))
        given = {tuple(key.split(".")): value for key, value in found.items()}
        values = dict(_values(parameters, (), given))
    except ValueError as error:
        raise InputError(f"{error}; see slimsfm {name} --help") from None
    values |= {
        one.name: shlex.join(["slimsfm", *name.split(), *arguments]) for one in parameters if one.mark(Typed)
    }
    kinds = signature(command.function).parameters
    first = [values.pop(key) for key, one in kinds.items() if one.kind is one.POSITIONAL_ONLY]
    return partial(command.function, *first, **values)


def help_of(command: Command, name: str) -> str:
    """Return what `--help` prints of a command."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    options = options_of(command)
    parts = [textwrap.fill(f"usage: {usage_of(command, name)}", width)]
    parts += [textwrap.fill(" ".join(one.split()), width) for one in command.description.split("\n\n")]
    groups = {
        "arguments": [one for one in options if not one.flags],
        "options": [one for one in options if one.flags and not one.is_advanced],
        "advanced": [one for one in options if one.flags and one.is_advanced],
    }
    for title, members in groups.items():
        if members:
            parts.append("\n".join([f"{title}:", *(_entry(one, width) for one in members)]))
    return "\n\n".join(parts)


def usage_of(command: Command, name: str) -> str:
    """Return the shortest command line of a command, with placeholders."""
    required = [_written(one) for one in options_of(command) if one.is_required]
    return " ".join(["slimsfm", name, *required, "[OPTIONS]"])


def nearest(word: str, known: Sequence[str]) -> str:
    """Return `; did you mean ...?` if a word resembles a known one, otherwise an empty string."""
    close = get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Escape characters that a terminal obeys instead of showing them: names come from files."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


def with_flags(message: str) -> str:
    """Write the options that a message of the library names, such as `overwrite=True`, as flags."""
    return re.sub(r"`(\w+)=(?:True|'([^']+)'|(\w+))`", _flag, message)


def _flag(match: re.Match[str]) -> str:
    return f"--{match[1].replace('_', '-')} {match[2] or match[3] or ''}".strip()


def _written(option: Option) -> str:
    """How a required argument stands in the usage."""
    return f"{option.flags[0]} {option.metavar}" if option.flags else option.metavar


def _entry(option: Option, width: int) -> str:
    head = f"  {', '.join(option.flags)} {option.metavar}".rstrip() if option.flags else f"  {option.metavar}"
    remark = " (required)" if option.flags and option.is_required else ""
    remark = f" (default: {option.default_text})" if option.default_text else remark
    indent = " " * _INDENT
    text = textwrap.fill(option.help + remark, width, initial_indent=indent, subsequent_indent=indent)
    return head + text[len(head) :] if len(head) < _INDENT - 1 else f"{head}\n{text}"


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(message.removeprefix("argument "))


def _parser_of(options: Sequence[Option]) -> ArgumentParser:
    parser = _Parser(add_help=False, allow_abbrev=False, argument_default=SUPPRESS)
    for option in options:
        key, kind = ".".join(option.key), option.kind
        names: dict[str, Any] = {"metavar": option.metavar}
        if option.flags:
            names = {"dest": key, "required": option.is_required}
        if kind is bool:
            parser.add_argument(*option.flags, action="store_true", **names)
            continue
        if get_origin(kind) is tuple:
            kind, names["nargs"] = get_args(kind)[0], "*" if option.flags else "+"
        choices = get_args(kind) if get_origin(kind) is Literal else None
        reader = _read_truth if kind is bool else str if choices else kind
        parser.add_argument(*(option.flags or (key,)), type=reader, choices=choices, **names)
    return parser


def _read_truth(text: str) -> bool:
    if text not in ("True", "False"):
        raise ValueError(text)
    return text == "True"


def _with_dashes(word: str) -> str:
    """An option may be written with underscores, too."""
    flag, equals, value = word.partition("=")
    return f"{flag.replace('_', '-')}{equals}{value}" if word.startswith("--") else word


def _check_flags(options: Sequence[Option], arguments: Sequence[str]) -> None:
    known = [flag for option in options for flag in option.flags]
    for word in arguments:
        flag = word.partition("=")[0]
        if flag.startswith("--") and flag not in known:
            raise ValueError(f"{flag} is not an option{nearest(flag, known)}")


def _values(
    parameters: Sequence[Parameter], path: tuple[str, ...], given: Mapping[tuple[str, ...], Any]
) -> Iterator[tuple[str, Any]]:
    """The parameters for which something was given, with their values."""
    for one in parameters:
        key = (*path, one.name)
        if key in given:
            yield one.name, tuple(given[key]) if isinstance(given[key], list) else given[key]
        elif any(other[: len(key)] == key for other in given):
            inner = dict(_values(one.fields(), key, given))
            yield one.name, one.kind(**inner) if one.default is MISSING else replace(one.default, **inner)
