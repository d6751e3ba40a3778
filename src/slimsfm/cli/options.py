"""From the signature of a command to its options.

A parameter of a simple type is an option; without a default it is required. A dataclass contributes its
fields. Help texts are the docstrings of functions and fields. Markers in `Annotated` change how a parameter
is written.
"""

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from inspect import cleandoc, getdoc, signature
from pathlib import Path
from sys import modules
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Argument:
    """Marks a positional argument."""

    metavar: str


class Flags(tuple[str, ...]):
    """Marks an option that is not written as its parameter is named."""

    __slots__ = ()


class Advanced(tuple[str, ...]):
    """Marks what is rarely needed: the named fields of a dataclass, or all of it if none is named."""

    __slots__ = ()


class Prefixed:
    """Marks a dataclass whose options start with the name of the parameter: `--build.seed`."""


class Positional:
    """Marks a dataclass whose required fields are positional arguments."""


class Typed:
    """Marks a parameter that is not an option: it gets the command line as it was typed."""


OutputPath = Annotated[Path, Flags(("-o", "--output"))]
MapPath = Annotated[Path, Argument("MAP")]
ImagesPath = Annotated[Path, Argument("IMAGES")]
ModelPath = Annotated[Path, Argument("MODEL")]


@dataclass(frozen=True)
class Command:
    """A function that the command line calls."""

    function: Callable[..., int | None]
    """Its signature is the command line; it may return an exit code."""

    types: Mapping[str, type] = field(default_factory=dict)
    """Dataclasses that stand in for the declared types of parameters."""

    @property
    def description(self) -> str:
        """The docstring of the function without its arguments."""
        return (getdoc(self.function) or "").partition("\nArgs:")[0].strip()


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option or a positional argument of a command."""

    key: tuple[str, ...]
    """The parameter and the fields that lead to it: `("localization", "ransac", "seed")`."""

    flags: tuple[str, ...]
    """How it is written; a positional argument has no flags."""

    kind: Any
    """A simple type, a `Literal` of strings or a tuple of these, without None."""

    default: Any
    """`MISSING` if a value is required."""

    metavar: str
    """What stands for the value in the help."""

    help: str
    """What it means, in one line."""

    is_advanced: bool
    """Whether it is rarely needed."""

    @property
    def is_required(self) -> bool:
        """Whether there is no default."""
        return self.default is MISSING

    @property
    def default_text(self) -> str:
        """The default as a user would write it; empty where nothing is set."""
        if self.is_required or self.default is None or self.default is False:
            return ""
        values = self.default if isinstance(self.default, tuple) else (self.default,)
        return " ".join(str(value) for value in values)


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter of a function or a field of a dataclass."""

    name: str
    kind: Any
    marks: tuple[Any, ...]
    default: Any

    def mark(self, marker: type) -> Any:
        """Return the marker of this class, if there is one."""
        return next((mark for mark in self.marks if mark is marker or isinstance(mark, marker)), None)

    def fields(self) -> "list[Parameter]":
        """Return the fields of its dataclass, with the defaults that its own default gives them."""
        hints = get_type_hints(self.kind, include_extras=True)
        found = []
        for one in fields(self.kind):
            default = one.default if one.default_factory is MISSING else one.default_factory()
            if self.default is not MISSING:
                default = getattr(self.default, one.name)
            parameter = _parameter(one.name, hints[one.name], default, {})
            if self.mark(Positional) and default is MISSING:
                parameter = replace(parameter, marks=(Argument(one.name.upper()),))
            found.append(parameter)
        return found


def parameters_of(command: Command) -> list[Parameter]:
    """Return the parameters of the function, in its order."""
    hints = get_type_hints(command.function, include_extras=True)
    return [
        _parameter(name, hints[name], MISSING if one.default is one.empty else one.default, command.types)
        for name, one in signature(command.function).parameters.items()
    ]


def options_of(command: Command) -> list[Option]:
    """Return the arguments and options of a command: positional ones first, advanced ones last."""
    texts = _texts_of_arguments(command.function)
    found = [
        option
        for one in parameters_of(command)
        if not one.mark(Typed)
        for option in _options(one, (one.name,), "", texts.get(one.name, ""), is_advanced=False)
    ]
    return sorted(found, key=lambda option: (bool(option.flags), option.is_advanced, not option.is_required))


def _parameter(name: str, hint: Any, default: Any, types: Mapping[str, type]) -> Parameter:
    base, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    return Parameter(name=name, kind=types.get(name, base), marks=tuple(marks), default=default)


def _options(
    of: Parameter, key: tuple[str, ...], prefix: str, text: str, *, is_advanced: bool
) -> Iterator[Option]:
    """The options of a parameter: itself, or what the fields of its dataclass give."""
    advanced = of.mark(Advanced)
    is_advanced = is_advanced or advanced == ()
    if is_dataclass(of.kind):
        inner, texts = f"{prefix}{of.name}." if of.mark(Prefixed) else prefix, _texts_of_fields(of.kind)
        for one in of.fields():
            apart = is_advanced or one.name in (advanced or ())
            yield from _options(one, (*key, one.name), inner, texts.get(one.name, ""), is_advanced=apart)
        return
    plain, argument = _without_none(of.kind), of.mark(Argument)
    written = f"--{prefix}{of.name.rstrip('_')}".replace("_", "-")
    yield Option(
        key=key,
        flags=() if argument else tuple(of.mark(Flags) or (written,)),
        kind=plain,
        default=of.default,
        metavar=argument.metavar if argument else _metavar(plain),
        help=text,
        is_advanced=is_advanced,
    )


def _without_none(hint: Any) -> Any:
    some = [one for one in get_args(hint) if one is not NoneType]
    return some[0] if len(some) < len(get_args(hint)) else hint


def _metavar(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return f"{_metavar(get_args(kind)[0]) or 'True|False'} ..."
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    return {bool: "", int: "N", float: "X", str: "NAME", Path: "PATH"}[kind]


def _texts_of_arguments(function: Callable[..., int | None]) -> dict[str, str]:
    """What the section `Args:` of a docstring says of each parameter, each in one line."""
    section = (getdoc(function) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    name = ""
    for line in section.splitlines():
        start = re.match(r" {4}(\w+): (.*)", line)
        if start:
            name, found[start[1]] = start[1], start[2]
        else:
            found[name] += f" {line.strip()}"
    return found


@cache
def _texts_of_fields(options: type) -> dict[str, str]:
    """The docstrings under the fields of a dataclass and of its bases, each in one line."""
    found: dict[str, str] = {}
    for base in reversed([one for one in options.__mro__ if is_dataclass(one)]):
        for line, following in _pairs_of_lines(base):
            match line, following:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    found[name] = " ".join(cleandoc(text).split())
    return found


def _pairs_of_lines(one: type) -> Iterator[tuple[ast.stmt, ast.stmt]]:
    source = Path(modules[one.__module__].__file__ or "").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and node.name == one.__name__:
            yield from zip(node.body, node.body[1:], strict=False)
