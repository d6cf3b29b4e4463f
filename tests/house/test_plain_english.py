"""The style of all pages: lines and paragraphs that can be read, words spelled right."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest

from tests.processes import ran

ROOT = Path(__file__).parents[2]
PAGES = {
    str(page.relative_to(ROOT)): page
    for folder in (ROOT, ROOT / "docs")
    for page in sorted(folder.glob("*.md"))
}
LINE, PARAGRAPH = 100, 80  # characters, words


def prose(text: str) -> str:
    """Without code, tables, formulas of their own and links, which cannot be broken."""
    text = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join(
        (
            ""
            if re.match(r" *\||    |.*\$\$|<!--|!\[", line)
            and not re.match(r" *(?:[-*]|\d+\.) ", line)
            else line
        )
        for line in text.splitlines()
    )


def long_lines(text: str) -> list[int]:
    """Their numbers of characters."""
    return [
        len(line)
        for line in prose(text).splitlines()
        if len(line) > LINE and " " in line[:LINE].strip()
    ]


def long_paragraphs(text: str) -> list[int]:
    """Their numbers of words; an item of a list is a paragraph."""
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", prose(text))
    return [len(part.split()) for part in parts if len(part.split()) > PARAGRAPH]


@pytest.mark.parametrize("name", PAGES)
def test_lines_and_paragraphs_are_short(name: str) -> None:
    text = PAGES[name].read_text(encoding="utf-8")
    assert not long_lines(text) and not long_paragraphs(text)


def test_words_are_spelled_right() -> None:
    """By codespell's list of common mistakes: ./with-fenicsx has it. CI's REQUIRE_BROWSER does without nothing."""
    if shutil.which("codespell") is None:
        assert not os.environ.get(
            "REQUIRE_BROWSER"
        ), "no codespell (environment/debian-packages.txt)"
        pytest.skip("no codespell: apt-get install codespell, or pip install codespell")
    ignored = ["--ignore-words-list", "mater,fro,larg,mke"]
    files = [
        *map(str, PAGES.values()),
        *(str(ROOT / room) for room in ("remodel_fenicsx", "demos", "docs", "benchmarks")),
    ]
    done = ran(
        [
            "codespell",
            "--skip",
            "*.js,*.json,*.pyc,*.svg,*.csv,example_report.html,_site",
            *ignored,
            *files,
        ]
    )
    assert done.returncode == 0, done.stdout[-3000:]
