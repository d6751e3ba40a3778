"""Style of matplotlib figures, and writing them into a page or a file.

Matplotlib's settings change only within these functions. Equal figures give equal bytes.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from html import escape
from io import StringIO
from math import log10
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from slimsfm.errors import OutputError
from slimsfm.files import replacing

INK = "#1c1d21"
"""Color of text and axes; on the page it becomes the color of the page's text."""

PAPER = "#fefefe"
"""Color that looks like the background; on the page it becomes the page's background."""

COLORS = ("#1f7fb0", "#d9660a", "#3d9040", "#9160ba", "#a08000", "#c2448f", "#6b7684")
"""Colors of categories, distinguishable on light and dark backgrounds."""

CHOSEN = "#d6231f"
"""Color of images that are kept."""

DROPPED = "#8a8d96"
"""Color of images that are dropped."""

BOX_COLOR = "#2268d8"
"""Color of the object's box."""

RIGHT_COLOR = "#12873a"
"""Color of queries that are localized correctly."""

FIGURE_FORMATS = (".svg", ".png", ".pdf")
"""Suffixes of the supported file formats."""

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "text.parse_math": False,  # a dollar sign is text
    "grid.alpha": 0.14,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "grid.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": INK,
    "patch.edgecolor": INK,
}
_WRITING: dict[Any, Any] = {
    "font.sans-serif": ["DejaVu Sans"],  # part of matplotlib, so that layouts are equal everywhere
    "svg.fonttype": "none",
    "svg.hashsalt": "slimsfm",
    "pdf.fonttype": 42,
}
_DPI = 160  # of PNG files, and of rasterized parts of the others
_NO_DATE: dict[str, dict[str, None]] = {
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
_FEW_DECADES = 2.2
_FONTS = "system-ui, sans-serif"  # on the page


@contextmanager
def styled() -> Iterator[None]:
    """Apply the common style to figures made within the context."""
    with mpl.rc_context(_STYLE):
        yield


def new_figure(width: float, height: float, label: str) -> Figure:
    """Make an empty figure; draw into it within `styled`.

    Args:
        width: In inches.
        height: In inches.
        label: Alternative text.
    """
    return Figure(figsize=(width, height), layout="compressed", label=label)


def mark_logarithmic(axis: Axis, write: Callable[[float], str]) -> None:
    """Put ticks at powers of ten on a logarithmic axis, and on short axes at 2 and 5 times these, too.

    Args:
        axis: Its limits must be final.
        write: Formats the value of a tick.
    """
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if log10(high / low) < _FEW_DECADES else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: write(value)))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def figure_svg(figure: Figure) -> str:
    """The figure as an SVG element for an HTML page.

    The background is transparent, `INK` becomes the color of the page's text and `PAPER` the page's
    background. Text stays text, and ids are unique to the figure.
    """
    text = _svg(figure, transparent=True)
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text, count=1, flags=re.DOTALL)
    text = text.replace(INK, "currentColor").replace(PAPER, "var(--card, #fff)")
    text = re.sub(r"'DejaVu Sans'(?:, sans-serif)?", _FONTS, text)
    return _with_head(_with_own_ids(text), figure)


def _svg(figure: Figure, *, transparent: bool) -> str:
    file = StringIO()
    with mpl.rc_context(_WRITING):
        figure.savefig(file, format="svg", metadata=_NO_DATE["svg"], transparent=transparent)
    return file.getvalue()


def _with_own_ids(text: str) -> str:
    """Drop unused ids, and make the others unique to the figure."""
    digest = sha256(text.encode()).hexdigest()[:8]
    used = set(re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", text))

    def renamed(match: re.Match) -> str:
        return f' id="{digest}-{match[1]}"' if match[1] in used else ""

    text = re.sub(r' id="([^"]+)"', renamed, text)
    return re.sub(r"(url\(#|href=\"#)", rf"\g<1>{digest}-", text)


def _with_head(text: str, figure: Figure) -> str:
    """Replace the tag of the element by one with alternative text and a maximum width."""
    width, height = (72 * side for side in figure.get_size_inches())
    head = (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(str(figure.get_label()))}" '
        f'style="width: 100%; max-width: {4 / 3 * width:.0f}px; height: auto; '
        'stroke-linejoin: round; stroke-linecap: butt" '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + text[text.index(">") + 1 :].rstrip()


def check_figure(path: Path) -> None:
    """Check the file format of a figure before any work is done.

    Raises:
        OutputError: The suffix is not a supported format.
    """
    if path.suffix.lower() not in FIGURE_FORMATS:
        raise OutputError(f"{path}: not a supported figure format ({', '.join(FIGURE_FORMATS)})")


def save_figure(figure: Figure, path: Path, *, overwrite: bool = False) -> None:
    """Write a figure on white, in the format of the file's suffix.

    Raises:
        OutputError: The suffix is not a supported format, the file exists and `overwrite` is off, or it
            cannot be written.
    """
    check_figure(path)
    kind = path.suffix.lower()[1:]
    with replacing(path, overwrite=overwrite) as partial, mpl.rc_context(_WRITING):
        figure.savefig(partial, format=kind, metadata=_NO_DATE[kind], facecolor="white", dpi=_DPI)
