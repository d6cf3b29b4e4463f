"""Terms and constructions that the project does not use, each with the most places that there may be."""

from __future__ import annotations

import ast
import runpy
from collections import defaultdict
from pathlib import Path

import pytest

WORDS = runpy.run_path(str(Path(__file__).parent / "words"))
CEILINGS = {  # of today, they may only fall; 0 for all others
    "Any in annotations": 231,
    "review terms": 222,
}


@pytest.fixture(scope="module")
def places() -> dict[str, list[str]]:
    return WORDS["measured"]()  # type: ignore[no-any-return]


def test_the_counts_are_below_their_ceilings(places: dict[str, list[str]]) -> None:
    beyond = {kind: found for kind, found in places.items() if len(found) > CEILINGS.get(kind, 0)}
    assert not beyond, "\n".join(place for found in beyond.values() for place in found[:20])


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (
            "def f():\n    '''Of the picture.'''",
            "docstrings that begin with a preposition or conjunction",
        ),
        ("def f():\n    '''What is made of the body.'''", "docstrings that begin with a pronoun"),
        (
            "def f():\n    '''Whether the body is at one place.'''",
            "docstrings 'Whether ...' of functions",
        ),
        ("def f():\n    '''Look.'''", "docstrings of three words or fewer"),
        ("found = 1", "results named found"),
        ("def f(found): pass", "results named found"),
        ("class A:\n    def of(self): pass", "methods named of"),
        ("a, b, c = 1, 2, 3", "tuple-to-tuple assignments with more than two targets"),
        ("x = a.b.c.d.e", "attribute chains of four or more"),
        ("def f(x: Any) -> int: pass", "Any in annotations"),
        ("print('the file is damaged')", "banned terms in messages"),
        ("print(f'{x}: the file is damaged')", "banned terms in messages"),
        ("# cells at rest", "banned terms in comments"),
    ],
)
def test_each_kind_is_noticed(
    code: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, places = tmp_path / "module.py", defaultdict(list)
    file.write_text(code)
    read = WORDS["read_module"]
    monkeypatch.setitem(read.__globals__, "PROJECT", tmp_path)
    ast.parse(code)
    read(places, file)
    assert kind in places
