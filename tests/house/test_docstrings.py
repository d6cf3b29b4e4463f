"""Docstrings of the public interface: numpydoc's sections, and examples that run.

What is asked is what a reader needs: every parameter, what comes back, an example. The examples run as doctests, all in
one child.
"""

from __future__ import annotations

import dataclasses
import doctest
import inspect
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

import remodel_fenicsx
from remodel_fenicsx import extend, parts
from remodel_fenicsx.schema.tables import Table
from tests.forks import forked

MODULES = (remodel_fenicsx, parts, extend)
PUBLIC = {
    name: getattr(module, name)
    for module in MODULES
    for name in module.__all__
    if not name.startswith("__")
}
DESCRIBED = {
    name: value
    for name, value in PUBLIC.items()
    if inspect.isclass(value) or inspect.isfunction(value)
}
HEADS = (
    "Parameters",
    "Attributes",
    "Returns",
    "Yields",
    "Raises",
    "Notes",
    "References",
    "Examples",
)


def sections(text: str) -> dict[str, str]:
    """Text under each of numpydoc's heads; "" is what comes before the first."""
    pieces = re.split(rf"^({'|'.join(HEADS)})\n-+\n", inspect.cleandoc(text), flags=re.MULTILINE)
    return {"": pieces[0], **dict(zip(pieces[1::2], pieces[2::2], strict=True))}


def entries(text: str) -> set[str]:
    """Names of a section; "a, b : type" are two."""
    heads = re.findall(r"^(\S.*)", text, re.MULTILINE)
    return {
        name.strip().lstrip("*") for head in heads for name in head.partition(" : ")[0].split(",")
    }


def own(value: Any) -> str:
    """The docstring that the object itself has; what dataclass writes is none."""
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    return "" if not text or text.startswith(f"{value.__name__}(") else text


def parameters(value: Any) -> list[str]:
    """What it is made with, or called with. Tables have keys in place of them."""
    made = inspect.isclass(value) and (
        dataclasses.is_dataclass(value) or hasattr(value, "_fields") or "__init__" in vars(value)
    )
    if inspect.isclass(value) and (
        not made or issubclass(value, Table) or getattr(value, "_is_protocol", False)
    ):
        return []
    return [
        name
        for name in inspect.signature(value).parameters
        if name not in ("self", "args", "kwargs")
    ]


def members(kind: type) -> Iterator[tuple[str, Any]]:
    """Public methods and properties of the package's own: name and function."""
    for name in dict.fromkeys(name for base in kind.__mro__ for name in vars(base)):
        base = next(base for base in kind.__mro__ if name in vars(base))
        member = vars(base)[name]
        function = (
            member.fget
            if isinstance(member, property)
            else (
                member.func
                if isinstance(member, cached_property)
                else getattr(member, "__func__", member)
            )
        )
        if (
            base.__module__.startswith("remodel_fenicsx")
            and name[0] != "_"
            and inspect.isfunction(function)
        ):
            yield name, function


def faults(value: Any) -> Iterator[str]:
    """What the docstring of a public class or function lacks."""
    said = sections(own(value))
    if not said[""].strip():
        yield "no docstring"
    if ">>> " not in said.get("Examples", ""):
        yield "no Examples"
    known = entries(said.get("Parameters", "")) | entries(said.get("Attributes", ""))
    yield from (
        f"parameter {name} is not described" for name in parameters(value) if name not in known
    )
    returned = inspect.isfunction(value) and value.__annotations__.get("return") not in (
        None,
        "None",
    )
    if returned and not re.match(r"\S.*\n +\S", said.get("Returns", "") + said.get("Yields", "")):
        yield "no Returns with a type and, indented, what it is"


@pytest.mark.parametrize("name", DESCRIBED)
def test_a_public_name_has_a_docstring_with_all_sections(name: str) -> None:
    value = DESCRIBED[name]
    found = list(faults(value))
    if inspect.isclass(value):
        found += [
            f"{name}: no docstring"
            for name, _ in members(value)
            if not inspect.getdoc(getattr(value, name))
        ]
    assert not found


@pytest.mark.parametrize("module", MODULES[1:], ids=lambda module: module.__name__)
def test_a_module_says_what_its_constants_are(module: Any) -> None:
    """Registries and dimensions have no docstring of their own: the module's has a section for them."""
    constants = {name for name in module.__all__ if name not in DESCRIBED}
    assert entries(sections(module.__doc__).get("Attributes", "")) == constants
    assert ">>> " in module.__doc__


def run_examples() -> None:
    """All of them, each name's with nothing but Python's own; prints what fails, then how many there were."""
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
    runner, parser = doctest.DocTestRunner(optionflags=flags), doctest.DocTestParser()
    texts = {name: own(value) for name, value in DESCRIBED.items()}
    texts |= {module.__name__: module.__doc__ or "" for module in MODULES}
    for name, value in DESCRIBED.items():
        if inspect.isclass(value):
            texts |= {
                f"{name}.{each}": inspect.getdoc(getattr(value, each)) or ""
                for each, _ in members(value)
            }
    for name, text in texts.items():
        runner.run(parser.get_doctest(text, {"__name__": "__main__"}, name, name, 0))
    print(f"{runner.failures} of {runner.tries} failed")


def test_the_examples_run(tmp_path: Path) -> None:
    program = "from tests.house.test_docstrings import run_examples; run_examples()"
    done = forked("python", program, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    failed, of = re.findall(r"^(\d+) of (\d+) failed$", done.stdout, re.MULTILINE)[-1]
    assert int(failed) == 0 and int(of) > 150, done.stdout[-5000:]
