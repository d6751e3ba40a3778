"""The bottom of the page: how the figures came about."""

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from slimsfm.evaluation.results import Run


def provenance_html(run: Run) -> str:
    """The data set, what was asked for, and on what it was measured."""
    options = {name: value for name, value in run.options.items() if name != "command"}
    parts = {"Options": options, "Environment": run.environment}
    lists = "\n".join(f"<div><h3>{title}</h3>\n{_list(values)}</div>" for title, values in parts.items())
    command = f"<pre>{escape(run.options['command'])}</pre>" if "command" in run.options else ""
    return f"""<section class="card"><h2>How this was measured</h2>
<p>{escape(run.dataset)}</p>{command}
<div class="lists">
{lists}
</div></section>"""


def _list(values: Mapping[str, Any]) -> str:
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in _flat(values))
    return f"<dl>{items}</dl>"


def _flat(values: Mapping[str, Any], start: str = "") -> Iterator[tuple[str, str]]:
    """Names and values, those of values in values with their way there."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{start}{name}.")
        elif isinstance(value, list | tuple):
            yield f"{start}{name}", ", ".join(str(one) for one in value)
        else:
            yield f"{start}{name}", str(value)
