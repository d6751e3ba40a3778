r"""Converts formulas to MathML, which browsers draw. GitHub draws the `$...$` itself.

`pymdownx.arithmatex` marks formulas as `\(...\)` and `\[...\]`; this hook converts what is marked.
"""

import re
from html import unescape
from typing import Any

from latex2mathml.converter import convert

_MARKED = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
_SPACED = re.compile(r"(<mi>(?:log|ln)</mi>)")  # latex2mathml adds no space after them
_BAR = re.compile(r"<mo>(&#x0007C;|&#x02016;)</mo>")  # of absolute values, not an operator


def on_page_content(html: str, **_: Any) -> str:
    """Replace the marked formulas of a page."""
    return _MARKED.sub(lambda match: to_mathml(match["latex"], displayed=match["open"] == "["), html)


def to_mathml(latex: str, *, displayed: bool) -> str:
    """Convert one formula from HTML; a `displayed` one gets its own line."""
    mathml = convert(unescape(latex).strip(), display="block" if displayed else "inline")
    spaced = _SPACED.sub(r'\1<mspace width="0.17em"/>', mathml)
    return _BAR.sub(r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>', spaced)
