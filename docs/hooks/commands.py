"""Tables of the options of every command, made of the program itself when the site is built."""

from collections.abc import Iterator
from typing import Any

PLACE = "<!-- the tables of all commands are inserted here -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the page that has the place for the tables."""
    return markdown.replace(PLACE, "\n\n".join(_sections())) if PLACE in markdown else markdown


def section_of(name: str) -> str:
    """Return the description of a command, its usage and the table of its options, as Markdown.

    Raises:
        KeyError: There is no such command.
    """
    from slimsfm.cli import COMMANDS
    from slimsfm.cli.options import options_of
    from slimsfm.cli.parsing import usage_of

    command = COMMANDS[name].load()
    options = options_of(command)
    groups = {
        "": [one for one in options if not one.is_advanced],
        "Advanced options": [one for one in options if one.is_advanced],
    }
    parts = [command.description, f"```sh\n{usage_of(command, name)}\n```"]
    for title, members in groups.items():
        if members:
            table = "\n".join(["| | | default |", "|---|---|---|", *(_row(one) for one in members)])
            parts.append(f'??? note "{title}"\n\n{_indented(table)}' if title else table)
    return "\n\n".join(parts)


def _sections() -> Iterator[str]:
    from slimsfm.cli import COMMANDS, GROUPS

    seen: set[str] = set()
    for name in COMMANDS:
        first, _, second = name.partition(" ")
        if second and first not in seen:
            yield f"## {first}\n\n{GROUPS[first].capitalize()}."
            seen.add(first)
        yield f"{'###' if second else '##'} {name}\n\n{section_of(name)}"


def _row(option: Any) -> str:
    written = ", ".join(option.flags) if option.flags else option.metavar
    if option.flags and option.metavar:
        written += f" {option.metavar}"
    default = f"`{option.default_text}`" if option.default_text else "required" if option.is_required else ""
    return f"| {_code(written)} | {_escaped(option.help)} | {default} |"


def _code(text: str) -> str:
    return f"`{text}`".replace("|", "\\|")


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())
