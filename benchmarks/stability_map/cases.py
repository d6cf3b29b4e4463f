"""What a case is: a scene, its place in the map, and the reference that it is held against."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from itertools import chain, product
from types import MappingProxyType
from typing import Any

import numpy as np

Values = dict[str, Any]


@dataclass
class Run:
    """What came out of a scene, as a user sees it (`runner.run_request`)."""

    code: int
    said: str = ""
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list)
    history: dict[str, list[float]] = field(default_factory=dict)
    fields: dict[str, Any] = field(default_factory=dict)
    companion: Run | None = None  # of the case's other scene, where it has one

    def column(self, name: str) -> np.ndarray:
        """A column of the steps after t = 0."""
        times = np.array(self.history["time"])
        return np.array(self.history[name])[times > 0]

    def tensor(self, name: str) -> np.ndarray:
        """A field of the last recorded time as tensors, (elements, 3, 3)."""
        return np.array(self.fields[name]).reshape(-1, 3, 3)

    def structure_tensor(self) -> np.ndarray:
        """A of the elements at the last recorded time, (elements, 3, 3)."""
        lengths = np.array(self.fields["cell_dimensions"])
        axes = np.stack([np.array(self.fields[f"axis_{i}"]) for i in (1, 2, 3)], axis=1)
        return np.einsum("ei,eia,eib->eab", lengths**2, axes, axes)


@dataclass
class Finding:
    """What a reference says of a run.

    Attributes
    ----------
    ratio
        Largest deviation over its tolerance, up to the last row: at most 1 is right; infinite where the reference has
        no equilibrium any more.
    words
        Which quantity deviates most, and by how much.
    unstable
        Whether the state is known to be a saddle of the energy; None where nobody has computed it.
    solvable
        Whether the reference reaches the end.
    confirmed
        Beginnings of warnings' texts, after the time, that the reference finds true although the row is within the
        tolerance, which has to be wide on such a mesh.
    """

    ratio: float
    words: str = ""
    unstable: bool | None = None
    solvable: bool = True
    confirmed: tuple[str, ...] = ()


Check = Callable[["Case", Run], Finding]


def farthest(off: Mapping[str, float], where: str = "", **more: Any) -> Finding:
    """What is off by most of its tolerances."""
    words, ratio = max(off.items(), key=lambda pair: pair[1])
    return Finding(float(ratio), f"{where}{words} off by {ratio:.3g} tolerances", **more)


@dataclass(frozen=True)
class Case:
    """A point of the map.

    Attributes
    ----------
    family, key
        Its row of the table; its name, unique.
    scene
        All its tables, in the present keys.
    check
        Holds a run against the reference.
    reference
        The reference in a few words.
    place
        Coordinates of the heat map: values by name.
    counts
        Numbers of elements that scenes cannot ask for (`runner.run_request`).
    extended
        Whether it needs the loads and bodies of `extensions`.
    base
        Demo scene that its changes lie over, and these changes: for the command that shows it.
    reduced
        Whether it is one of the reduced map's.
    options
        What the check wants to know.
    companion
        Another scene that the check wants to see, such as the same with half of the step.
    """

    family: str
    key: str
    scene: Values
    check: Check
    reference: str
    place: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, Any] = field(default_factory=dict)
    extended: bool = False
    base: tuple[str, Values] | None = None
    reduced: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    companion: Values | None = None

    @property
    def command(self) -> str:
        """The smallest command that shows it."""
        if self.base is None or self.extended or self.counts:
            return f"./with-fenicsx benchmarks/stability.py --only '{self.key}' --again"
        changes = " ".join(f"--set {toml_set(key, value)}" for key, value in self.base[1].items())
        return f"./with-fenicsx remodel-fenicsx run {self.base[0]} {changes}"


def toml_set(key: str, value: Any) -> str:
    """KEY=VALUE for a shell."""
    if isinstance(value, bool):
        return f"{key}={str(value).lower()}"
    if isinstance(value, (list, tuple)):
        return f"'{key}={[list(entry) if isinstance(entry, tuple) else entry for entry in value]}'"
    return f"{key}={value}"


def with_values(scene: Mapping[str, Any], changes: Mapping[str, Any]) -> Values:
    """A copy of nested tables with other values by dotted key."""
    copy: Values = {
        name: with_values(value, {}) if isinstance(value, Mapping) else value
        for name, value in scene.items()
    }
    for key, value in changes.items():
        table, *names = copy, *key.split(".")
        for name in names[:-1]:
            table = table.setdefault(name, {})
        table[names[-1]] = value
    return copy


MODULES = ("homogeneous", "bodies", "variants", "ray")
Place = dict[str, Any]
OfPlace = Mapping[str, Any] | Callable[[Place], Mapping[str, Any]]
FAMILIES: dict[str, list[Callable[[], Iterator[Case]]]] = {}
"""Tables of cases by the name of their family, in the order of the report."""
KEYS = {
    "frame": "remodeling.frame", "driver": "remodeling.driver", "law": "remodeling.law",
    "coupling": "remodeling.coupling", "kappa dt": "remodeling.kappa", "force": "loads.force.value",
    "pressure": "loads.pressure.value", "stretch": "loads.elongation.value", "density": "material.chain_density",
    "lambda/mu": "material.lame_lambda", "distortion": "geometry.distortion", "degree": "mesh.degree",
    "refinement": "mesh.refinement", "outer radius": "geometry.outer_radius",
}  # fmt: skip
"""Coordinates of places that are keys of scenes."""
MU = 3.103  # of all bodies but the carotid


def table(
    family: str,
    make: Callable[..., Case],
    axes: Mapping[str, Iterable[Any]],
    changes: OfPlace = MappingProxyType({}),
    only: Callable[[Place], bool] | None = None,
    reduced: Callable[[Place], bool] | None = None,
    more: OfPlace = MappingProxyType({}),
) -> None:
    """Register a case for each place of a grid.

    Parameters
    ----------
    make
        Of family, changes of the scene by dotted key, place and further arguments.
    axes
        Values by coordinate. Those in `KEYS` change the scene by themselves; lambda/mu is times mu there.
    changes, more
        Further changes and arguments: mappings, or functions of the place.
    only, reduced
        Whether a place is there, and whether it is in the reduced map; default: all are, none is.
    """

    def cases() -> Iterator[Case]:
        for values in product(*axes.values()):
            place = dict(zip(axes, values, strict=True))
            if only is None or only(place):
                asked = {KEYS[name]: value for name, value in place.items() if name in KEYS}
                if "lambda/mu" in place:
                    asked[KEYS["lambda/mu"]] *= MU
                asked |= changes(place) if callable(changes) else changes
                given = dict(more(place) if callable(more) else more)
                yield make(
                    family, asked, place, reduced=reduced is not None and reduced(place), **given
                )

    FAMILIES.setdefault(family, []).append(cases)


def named(family: str, place: Place) -> str:
    """The key of a case."""
    return f"{family}: " + ", ".join(f"{name} {value}" for name, value in place.items())


def all_cases() -> dict[str, Case]:
    """Every case by its key.

    Raises
    ------
    ValueError
        If two have the same key.
    """
    for name in MODULES:
        import_module(f"benchmarks.stability_map.{name}")  # it registers its families
    found: dict[str, Case] = {}
    for tables in FAMILIES.values():
        for case in chain.from_iterable(make() for make in tables):
            if case.key in found:
                raise ValueError(f"two cases are called {case.key}")
            found[case.key] = case
    return found
