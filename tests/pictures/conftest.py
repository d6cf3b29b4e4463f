"""The runs of reports are drawn too."""

from __future__ import annotations

from tests.report.conftest import recorded

__all__ = ["recorded"]
