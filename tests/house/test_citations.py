"""Works that pages name are in their bibliography, works that the paper cites in its own, and the other way round."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "paper" / "paper.md"
_, HEAD, TEXT = PAPER.read_text(encoding="utf-8").split("---\n", 2)
WORKS = PAPER.with_suffix(".bib").read_text(encoding="utf-8")
ENTRIES = (ROOT / "docs" / "bibliography.md").read_text(encoding="utf-8")
MONTHS = (
    "January February March April May June July August September October November December"
).split()


def in_one_form(text: str) -> str:
    """Names and years as `A, B and C 2006`, whatever stands around them."""
    return re.sub(r"\s+", " ", text.replace("(", "").replace(", 1", " 1").replace(", 2", " 2"))


def test_every_work_that_a_page_names_is_in_the_bibliography_and_the_other_way_round() -> None:
    pages = [
        ROOT / "README.md",
        *(page for page in (ROOT / "docs").glob("*.md") if page.stem != "bibliography"),
    ]
    text = in_one_form(" ".join(page.read_text(encoding="utf-8") for page in pages))
    keys = [in_one_form(key) for key in re.findall(r"^- \*\*(.*)\.\*\*", ENTRIES, re.MULTILINE)]
    named = re.findall(r"\b(([A-Z][\w-]+)(?: et al\.)? (?:18|19|20)\d\d)\b(?![.-]?\d)", text)
    wanted = {work for work, name in named if name not in MONTHS}
    assert len(keys) > 15 and len(set(keys)) == len(keys)
    assert not {work for work in wanted if not any(key.endswith(work) for key in keys)}
    assert not [key for key in keys if key.casefold() not in text.casefold()]


def test_the_paper_and_its_bibliography_name_the_same_works_and_its_figures_are_there() -> None:
    """As the Journal of Open Source Software asks for them."""
    assert set(re.findall(r"@(\w+)", TEXT)) == set(
        re.findall(r"^@\w+\{(\w+),", WORKS, re.MULTILINE)
    )
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT):
        assert (PAPER.parent / picture).is_file(), picture
    assert all(
        f"\n{key}:" in f"\n{HEAD}"
        for key in ("title", "tags", "authors", "affiliations", "date", "bibliography")
    )
    assert all(
        f"\n# {title}" in TEXT
        for title in ("Summary", "Statement of need", "State of the field", "References")
    )


def test_every_decimal_of_the_paper_stands_on_a_page_that_is_made_of_runs() -> None:
    """The pages are made by `docs/make verification` and `docs/make validation`."""
    pages = [ROOT / "docs" / f"{name}.md" for name in ("verification", "validation")]
    known = re.findall(r"\d+\.\d+", " ".join(page.read_text(encoding="utf-8") for page in pages))
    numbers = set(re.findall(r"\d+\.\d+", TEXT))
    assert len(numbers) > 10
    assert not numbers - set(known)


def test_the_paper_has_the_sections_and_the_length_that_its_journal_asks_for() -> None:
    for title in ("Software design", "Research impact statement", "AI usage disclosure"):
        assert f"\n# {title}\n" in TEXT
    assert 750 <= len(TEXT.split()) <= 1750


def test_the_paper_and_the_pages_cite_the_same_work_in_the_same_way() -> None:
    """Volume, first and last page of each work with a DOI that both bibliographies have."""
    shared = 0
    for work in WORKS.split("\n@"):
        fields = dict(re.findall(r"(\w+)\s*= \{(.*)\}", work))
        for entry in ENTRIES.split("\n- "):
            if f"[{fields.get('doi')}]" in entry:
                place = f"{fields['volume']}, {fields['pages']}.".replace("--", "–")
                assert place in re.sub(r"\s+", " ", entry), place
                shared += 1
    assert shared >= 9
