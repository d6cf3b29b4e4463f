"""tests/house/size: what it counts."""

from __future__ import annotations

import runpy
from pathlib import Path

SIZE = runpy.run_path(str(Path(__file__).with_name("size")))
SOURCE = '''"""A module.

Of two lines.
"""

# a comment
NAME = "of text"  # and one beside it
TEXT = """counts,

but for the empty line between"""


def function() -> None:
    """No code."""
    "a text that is none of its docstrings"
'''


def test_neither_blank_lines_nor_comments_nor_docstrings_are_code(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(SOURCE)
    assert SIZE["code_lines"](path) == 5


def test_every_ceiling_is_of_something_that_is_counted() -> None:
    sizes, rooms = SIZE["measured"]()
    assert set(SIZE["CEILINGS"]) <= set(sizes) and sizes["code"] == rooms.total()
