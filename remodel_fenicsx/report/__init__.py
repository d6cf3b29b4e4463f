"""A run as one page for a browser, which needs no network: what was run, how it went, the body in space.

`write_report` makes it of a run's folder alone, without dolfinx. A page is a list of parts, `parts.PAGE_PARTS`. Each
gives a card: HTML and, for what moves, data and arrays that the scripts in `assets/` take under the card's name.
"""

from __future__ import annotations

from remodel_fenicsx.report.page import REPORT, ReportError, write_report

__all__ = ["REPORT", "ReportError", "write_report"]
