"""Pages and figures of benchmark runs.

Imports matplotlib only when one of these names is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slimsfm.report.figure_files import WrittenFigures, write_figures
    from slimsfm.report.page import report_html, write_report

__all__ = ["WrittenFigures", "report_html", "write_figures", "write_report"]

_MODULES = {
    "WrittenFigures": "figure_files",
    "report_html": "page",
    "write_figures": "figure_files",
    "write_report": "page",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
