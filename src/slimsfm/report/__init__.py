"""One self-contained HTML page that shows what cutting a map down cost and gained."""

from slimsfm.report.page import report_html, write_report

__all__ = ["report_html", "write_report"]
