"""A run as one page for a browser, which needs no network: what was run, how it went, the body in space.

`write_report` makes it of a run's folder alone, without dolfinx. A page is a list of parts (`parts.PARTS`); each gives a
card, that is HTML and, for what moves, data and arrays that the script of the same name in `assets/` takes.
"""

from __future__ import annotations

from remodel_fenicsx.report.page import SIZE, ReportError, write_report

__all__ = ["SIZE", "ReportError", "write_report"]
