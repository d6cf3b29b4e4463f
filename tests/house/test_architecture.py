"""The structure is what docs/architecture.md and CONTRIBUTING.md say: rooms, arrows, registries."""

from __future__ import annotations

import ast
import functools
import pkgutil
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.processes import ran


ROOT = Path(__file__).parents[2]
PACKAGE = "remodel_fenicsx"
# what a room may import: itself, and those before it
ROOMS = ("errors", "_renamed", "_lazy", "_version", "system", "schema", "model", "fem", "kernels",
         "schema.settings", "body", "scene", "state", "solver", "evolution", "watch", "results", "report", "initial",
         "simulation", "unloading", "running", "studies", "pictures", "recording", "cli", "parts",
         "extend")  # fmt: skip


@dataclass(frozen=True)
class Import:
    """A module of the package (dotted, without the package) that another names; when: module, function or types."""

    importer: str
    imported: str
    when: str


def modules() -> dict[str, Path]:
    """By dotted name without the package; a room's face is the room."""
    found = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT / PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)] = path
    return found


@functools.cache
def imports_of(path: Path) -> list[tuple[str, str]]:
    """(dotted name of what is imported, when) for every import in a file, whatever is imported."""

    def walk(nodes: list[ast.stmt], when: str) -> Iterator[tuple[str, str]]:
        for node in nodes:
            if isinstance(node, ast.Import):
                yield from ((alias.name, when) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0 and node.module, f"{path}: a relative import"
                yield from ((f"{node.module}.{alias.name}", when) for alias in node.names)
            elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                yield from walk(node.body, "types")
                yield from walk(node.orelse, when)
            else:
                inside = (
                    "function"
                    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
                    else when
                )
                bodies = [getattr(node, field, []) for field in ("body", "orelse", "finalbody")]
                bodies += [handler.body for handler in getattr(node, "handlers", [])]
                yield from walk([statement for body in bodies for statement in body], inside)

    return list(walk(ast.parse(path.read_text(encoding="utf-8")).body, "module"))


def arrows() -> list[Import]:
    """All imports of modules of the package in the package."""
    known, found = modules(), []
    for name, path in known.items():
        for imported, when in imports_of(path):
            parts = imported.split(".")
            if parts[0] != PACKAGE:
                continue
            inner = ".".join(parts[1:])
            while inner and inner not in known:  # the name of something in a module
                inner = inner.rpartition(".")[0]
            found.append(Import(name, inner or "__init__", when))
    return found


def room(module: str) -> str:
    """The room of a module; the tables of a scene name parts of rooms above the other modules of theirs."""
    tables = module.startswith(("schema.settings", "schema.processes"))
    return "schema.settings" if tables else module.split(".")[0]


def test_every_file_is_in_a_room() -> None:
    assert {room(name) for name in modules()} == {*ROOMS, "__init__", "__main__"}


def test_no_arrow_runs_upwards() -> None:
    """Functions that import when they are called included."""
    floor = {name: number for number, name in enumerate(ROOMS)}
    upward = [
        arrow for arrow in arrows()
        if arrow.when != "types" and room(arrow.importer) in floor and room(arrow.imported) in floor
        and floor[room(arrow.imported)] > floor[room(arrow.importer)]
    ]  # fmt: skip
    assert not upward


def test_scripts_beside_the_package_import_what_is_there() -> None:
    """Nothing else runs most of them: what they import may move away unnoticed."""
    scripts = [
        path
        for folder in ("benchmarks", "demos", "docs")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    assert len(scripts) > 20
    for path in scripts:
        for imported, _ in imports_of(path):
            if imported.split(".")[0] == PACKAGE:
                pkgutil.resolve_name(imported)  # raises, if it is not


def test_the_package_itself_only_hands_names_on() -> None:
    """Whoever asks for its version imports nothing else, and no room asks the package itself."""
    assert {
        arrow.imported
        for arrow in arrows()
        if arrow.importer == "__init__" and arrow.when != "types"
    } == {
        "_lazy",
        "_version",
    }
    assert not [arrow for arrow in arrows() if arrow.imported == "__init__"]
    assert {room(arrow.imported) for arrow in arrows() if arrow.importer == "__main__"} == {"cli"}


SCENES = (
    "schema",
    "body",
    "scene",
)  # without a circle of files, whenever they import and whatever for


def test_no_modules_import_each_other_in_a_circle() -> None:
    after: dict[str, set[str]] = {}
    for arrow in arrows():
        of_scenes = {arrow.importer.split(".")[0], arrow.imported.split(".")[0]} <= {*SCENES}
        if (arrow.when == "module" or of_scenes) and arrow.importer != arrow.imported:
            after.setdefault(arrow.importer, set()).add(arrow.imported)
            parent = arrow.imported.rpartition(".")[
                0
            ]  # importing a module runs the face of its room first
            if parent and parent != room(arrow.importer):
                after[arrow.importer].add(parent)

    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for following in sorted(after.get(module, ())):
                visit(following, (*way, module))
            done.add(module)

    for module in modules():
        visit(module, ())


@pytest.mark.parametrize(("inside", "never"), [
    ("model", {"dolfinx", "basix", "petsc4py", "mpi4py", "gmsh", "pydantic"}),
    ("schema", {"dolfinx", "basix", "petsc4py", "mpi4py", "gmsh", "ufl"}),
    ("schema.settings", {"dolfinx", "basix", "petsc4py", "mpi4py", "gmsh", "ufl"}),
    ("scene", {"dolfinx", "basix", "petsc4py", "mpi4py", "gmsh", "ufl"}),
    *((room, {"gmsh", "pydantic", "h5py"}) for room in ("state", "solver", "evolution", "watch")),
    ("fem", {"gmsh", "pydantic"}),
])  # fmt: skip
def test_a_room_does_without(inside: str, never: set[str]) -> None:
    found = {
        (name, imported.split(".")[0])
        for name, path in modules().items()
        if room(name) == inside
        for imported, when in imports_of(path)
        if when != "types" and imported.split(".")[0] in never
    }
    assert not found


@pytest.mark.parametrize(("module", "never"), [
    (PACKAGE, "numpy dolfinx basix mpi4py petsc4py gmsh ufl pint h5py pydantic"),
    (f"{PACKAGE}.scene", "dolfinx basix mpi4py petsc4py gmsh ufl pint h5py"),
    (f"{PACKAGE}.extend", "dolfinx basix mpi4py petsc4py gmsh ufl pint h5py"),
    (f"{PACKAGE}.model.laws", "dolfinx basix mpi4py petsc4py gmsh ufl pydantic"),
    (f"{PACKAGE}.results.recording", "dolfinx basix mpi4py petsc4py gmsh ufl pint pydantic"),
    (f"{PACKAGE}.report", "dolfinx basix mpi4py petsc4py gmsh ufl pint matplotlib"),
])  # fmt: skip
def test_importing_costs_no_more_than_it_must(module: str, never: str) -> None:
    program = (
        f"import sys, {module}; print(*(name for name in {never.split()} if name in sys.modules))"
    )
    done = ran([sys.executable, "-c", program], cwd=ROOT)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_a_scene_imports_no_other_shape() -> None:
    others = [
        f"{PACKAGE}.body.{name}"
        for name in ("cube", "tendon", "sheet", "mesh_body", "mesh_file", "mesh_faces")
    ]
    scene = f"{PACKAGE}.scene.preset_scene('consistent', 'tube')"
    program = f"import sys, {PACKAGE}.scene; {scene}; print(*(name for name in {others} if name in sys.modules))"
    done = ran([sys.executable, "-c", program], cwd=ROOT)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


# ---------------------------------------------------------------- one name, one meaning
def test_no_name_has_two_meanings() -> None:
    """No two classes of one name, and no constant of one name with two values."""
    classes: dict[str, set[str]] = {}
    constants: dict[str, set[str]] = {}
    for module, path in modules().items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, set()).add(module)
            if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=True))
                for name, value in pairs:
                    if isinstance(name, ast.Name) and name.id.isupper():
                        constants.setdefault(name.id, set()).add(ast.unparse(value))
    assert len(classes) > 100 and len(constants) > 100
    assert not {name: places for name, places in classes.items() if len(places) > 1}
    assert not {name: values for name, values in constants.items() if len(values) > 1}


def test_names_in_docstrings_are_there() -> None:
    """`module.name` in a docstring, a comment or docs/architecture.md is a name of this module."""
    pages = [*modules().values(), ROOT / "docs" / "architecture.md"]
    files = {path.stem: path for path in modules().values() if path.stem != "__init__"}
    lost = [
        f"{path.name}: {owner}.{name}"
        for path in pages
        for owner, name in re.findall(
            r"`+(?:\w+\.)*(\w+)\.(\w+)(?:\.\w+)*`+", path.read_text(encoding="utf-8")
        )
        if owner in files.keys() - {"parts", "extend"}
        and name not in ("py", "c", "toml", "csv", "msh")
        and not re.search(rf"\b{name}\b", files[owner].read_text(encoding="utf-8"))
    ]
    assert not lost
