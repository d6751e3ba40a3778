"""One self-contained HTML page that shows what cutting a map down cost and gained."""

from slimsfm.report.frames import QueryFrame
from slimsfm.report.page import ObjectReport, write_report

__all__ = ["ObjectReport", "QueryFrame", "write_report"]
