"""docs/interface.md, the list of everything that is public, and the tables of docs/commands.md.

A change of the interface is a change of that page: `./with-fenicsx docs/make interface`, and CHANGELOG.md says so.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import itertools
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from types import ModuleType
from typing import Any

from mpi4py import MPI

import remodel_fenicsx
from remodel_fenicsx import cli, extend, parts
from remodel_fenicsx._renamed import OldAttribute
from docs.making.pages import DOCS, markdown
from remodel_fenicsx.body.shape import (
    COLUMNS_ON_REQUEST,
    Column,
    Shape,
    WithRegions,
    columns_of,
    columns_on_request,
)
from remodel_fenicsx.schema.tables import Table
from remodel_fenicsx.solver.attempts import ATTEMPTS

HEAD = """# The public interface

This page is made from the code: `./with-fenicsx docs/make interface`. Scripts, scenes and notebooks
may rely on what stands here; [CHANGELOG.md](../CHANGELOG.md) says when some of it changes. All else
is private and changes without notice, also what a public object hands out and is not listed.

Public are also the keys of scenes ([scene.md](scene.md)), and the columns of histories and the exit
codes ([commands.md](commands.md)). Docstrings say what a name means.
"""
MODULES = {
    remodel_fenicsx: "run a scene, read what it left",
    parts: "assemble a simulation in a script",
    extend: "add to what scenes may name",
}


def page() -> str:
    """The whole page."""
    text, seen = HEAD, dict[int, str]()
    for module, use in MODULES.items():
        text += f"\n## `{module.__name__}`: {use}\n\n```python\n{_wrapped(_module(module, seen), '        ')}\n```\n"
    return text + f"\n## Commands\n\n```text\n{_wrapped(_commands(cli.parser()), '    ')}\n```\n"


def schema() -> str:
    """docs/scene.schema.json, as the command prints it."""
    command = [sys.executable, "-m", "remodel_fenicsx.cli", "schema"]
    return subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=DOCS.parent
    ).stdout


def _wrapped(lines: Iterable[str], indent: str = "  ") -> str:
    return "\n".join(
        textwrap.fill(line, 100, subsequent_indent=indent, break_on_hyphens=False) for line in lines
    )


# ---------------------------------------------------------------- names
def _module(module: ModuleType, seen: dict[int, str]) -> Iterator[str]:
    """The names of a module; what an earlier one has too is described there."""
    for name in sorted(module.__all__):
        value = getattr(module, name)
        where = seen.setdefault(id(value), module.__name__)
        if where != module.__name__:
            yield f"{name}  # that of {where}"
        elif inspect.isclass(value):
            yield from described(value)
        elif callable(value):
            yield name + _parameters(value if inspect.isfunction(value) else type(value).__call__)
        elif isinstance(value, Mapping):
            known = (repr(key) for key, part in value.items() if getattr(part, "meaning", True))
            yield f"{name} = {{{', '.join(known)}}}"
        else:
            yield f"{name}: {type(value).__name__}"


def described(kind: type) -> Iterator[str]:
    """How it is made, its attributes and methods without those of a public base."""
    public = {
        value
        for module in MODULES
        for name in module.__all__
        if inspect.isclass(value := getattr(module, name))
    }
    lineage = [
        base
        for base in kind.__mro__
        if base.__module__.startswith("remodel_fenicsx.") and base is not Table
    ]
    bases = [base for base in lineage[1:] if base in public]
    own = [owner for owner in lineage if not any(issubclass(base, owner) for base in bases)]
    fields = (
        {field.name for field in dataclasses.fields(kind)}
        if dataclasses.is_dataclass(kind)
        else set[str]()
    )
    fields |= {
        *getattr(kind, "_fields", ()),
        *getattr(kind, "model_fields", ()),
    }  # of a tuple, of a table
    members: dict[str, str] = {}
    for owner in reversed(own):
        members |= {name: name for name in _documented(owner)}
        members |= {
            name: name + _parameters(member)
            for name, member in vars(owner).items()
            if not isinstance(member, OldAttribute)
        }
    made = ""
    if issubclass(kind, Table):
        made = "(**keys)"
    elif fields or "__init__" in members and not getattr(kind, "_is_protocol", False):
        made = _parameters(kind)
    yield f"class {kind.__name__}{made}" + (f"  # a {bases[0].__name__}" if bases else "")
    hidden = {"model_config", *fields}
    yield from (
        f"    {members[name]}"
        for name in sorted(members)
        if name not in hidden and not name.startswith("_")
    )


def _documented(kind: type) -> list[str]:
    """Names in the section "Attributes" of a docstring."""
    text = inspect.cleandoc(vars(kind).get("__doc__") or "")
    section = re.search(
        r"^Attributes\n-+\n(.*?)(?=\n\w[\w ]*\n-+\n|\Z)", text, re.DOTALL | re.MULTILINE
    )
    heads = re.findall(r"^(\w[^:\n]*)", section[1], re.MULTILINE) if section else []
    return [name.strip() for head in heads for name in head.split(",")]


def _parameters(function: Any) -> str:
    """Parameters in brackets with their defaults; nothing for what is no function."""
    function = inspect.unwrap(getattr(function, "__func__", function))  # of a class method
    if not inspect.isfunction(function) and not inspect.isclass(function):
        return ""
    signature = inspect.signature(function)
    parameters = [
        parameter.replace(
            annotation=parameter.empty,
            default=(
                parameter.empty
                if parameter.default is parameter.empty
                else _Default(parameter.default)
            ),
        )
        for name, parameter in signature.parameters.items()
        if name not in ("self", "cls")
    ]
    return str(signature.replace(parameters=parameters, return_annotation=signature.empty))


class _Default:
    """A default as a reader knows it."""

    def __init__(self, value: Any):
        plain = (
            repr(value)
            if value is None or isinstance(value, (bool, int, float, str, tuple))
            else "..."
        )
        self.text = (
            "MPI.COMM_WORLD" if isinstance(value, MPI.Comm) else getattr(value, "__name__", plain)
        )

    def __repr__(self) -> str:
        return self.text


# ---------------------------------------------------------------- the rest
def _parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Commands with a help text."""
    (commands,) = (
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    )
    return {listed.dest: commands.choices[listed.dest] for listed in commands._choices_actions}


def _commands(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield " ".join([parser.prog, *_arguments(parser)])
    for name, found in _parsers(parser).items():
        yield " ".join([parser.prog, name, *_arguments(found)])


def _listed(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    hidden = (argparse._HelpAction, argparse._SubParsersAction)
    return [action for action in parser._actions if not isinstance(action, hidden)]


def _label(action: argparse.Action) -> str:
    """Names and value."""
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else ""
    value = (action.metavar or choices or action.dest.upper()) if action.nargs != 0 else ""
    return " ".join(filter(None, ["|".join(action.option_strings), str(value)]))


def _arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in _listed(parser):
        text = _label(action)
        yield text if action.required and action.nargs != "*" else f"[{text}]"


def commands_table() -> str:
    """Every command with its help text."""
    rows = (
        (f"[`{name}`](#{name})", found.description or "")
        for name, found in _parsers(cli.parser()).items()
    )
    return markdown(("command", "purpose"), rows)


def options_table() -> str:
    """Every argument and option with its commands; those that all commands have come last."""
    parsers = _parsers(cli.parser())
    rows: dict[tuple[str, str], list[str]] = {}
    for name, found in parsers.items():
        for action in _listed(found):
            meaning = found._get_formatter()._expand_help(action)
            rows.setdefault((_label(action), meaning), []).append(name)
    names = {key: "all" if len(of) == len(parsers) else ", ".join(of) for key, of in rows.items()}
    ordered = sorted(names, key=lambda key: names[key] == "all")
    cells = (["`" + key[0].replace("|", ", ") + "`", names[key], key[1]] for key in ordered)
    return markdown(["argument or option", "of", "meaning"], cells)


# ---------------------------------------------------------------- columns
def of_shape(kind: type[Shape]) -> tuple[list[Column], list[Column]]:
    """Columns that a shape always has, and those of its own that it has on request."""
    regions = ["NAME"] if issubclass(kind, WithRegions) else []
    always = columns_of(kind, loads=(), regions=regions)
    known = {column.name for column in always}
    of_loads = [column for column in columns_of(kind, regions=regions) if column.name not in known]
    held = columns_on_request(kind, held=["NAME"] if kind.supported_faces is None else [])
    of_supports = [column for name, column in held.items() if name.startswith("support_force_")]
    return list(always), [*of_loads, *kind.columns_on_request, *of_supports]


def attempts_table() -> str:
    """What is tried where a solve fails, in its order."""
    rows = (
        (str(number), one.what, f"`{one.where}`") for number, one in enumerate(ATTEMPTS, start=1)
    )
    return markdown(("", "what", "where"), rows)


def columns_table() -> str:
    """Every column with the shapes that have it: those of all shapes first, then those on request."""
    found: list[dict[tuple[str, str, str], list[str]]] = [{}, {}]
    for shape, kind in extend.SHAPES.items():
        for having, columns in zip(found, of_shape(kind), strict=True):
            for column in columns:
                having.setdefault((column.name, column.unit, column.meaning), []).append(shape)
    everywhere = list(extend.SHAPES)
    always = sorted(found[0].items(), key=lambda item: item[1] != everywhere)
    rows = [(key, "all" if shapes == everywhere else ", ".join(shapes)) for key, shapes in always]
    rows += [(key, f"{', '.join(shapes)}, on request") for key, shapes in found[1].items()]
    rows += [
        ((column.name, column.unit, column.meaning), "on request")
        for column in COLUMNS_ON_REQUEST.values()
    ]
    cells = (
        [", ".join(f"`{name}`" for name in names), of, unit, meaning]
        for names, of, unit, meaning in together(rows)
    )
    return markdown(["column", "of", "unit", "meaning"], cells)


def together(
    rows: Iterable[tuple[tuple[str, str, str], str]],
) -> Iterator[tuple[list[str], str, str, str]]:
    """Columns of one quantity at several places in one row: those with one stem whose meanings are nearly the same."""

    def stem(row: tuple[tuple[str, str, str], str]) -> tuple[str, str, str]:
        (name, unit, _), of = row
        return name.rpartition("_")[0] or name, unit, of

    for (_, unit, of), found in itertools.groupby(rows, stem):
        group = [key for key, _ in found]
        names, meanings = [name for name, _, _ in group], [meaning for _, _, meaning in group]
        one = one_meaning(meanings)
        if one is not None:
            yield names, of, unit, one
        else:
            yield from (
                ([name], of, unit, meaning) for name, meaning in zip(names, meanings, strict=True)
            )


def one_meaning(meanings: list[str]) -> str | None:
    """Of meanings that differ in one place alone: what they share, and there what each of them says."""
    words = [meaning.split() for meaning in meanings]
    before = common(words)
    rest = [line[before:] for line in words]
    after = common([line[::-1] for line in rest])
    differing = [" ".join(line[: len(line) - after]) for line in rest]
    if 2 * (before + after) < max(map(len, words)):
        return None
    if len(words) == 1:
        return meanings[0]
    mark = differing[0][-1:] if differing[0][-1:] in (",", ":") else ""
    parts = [part.removesuffix(mark) for part in differing]
    said = "; ".join(parts) if len(parts) < 5 else f"{parts[0]} to {parts[-1]}"
    return " ".join([*words[0][:before], said + mark, *words[0][len(words[0]) - after :]])


def common(lines: list[list[str]]) -> int:
    """How many words all lines begin with."""
    return sum(1 for _ in itertools.takewhile(lambda words: len(set(words)) == 1, zip(*lines)))
