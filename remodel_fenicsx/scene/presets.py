"""What lies under or over the keys of a scene that names it: the presets of the paper, and profiles of accuracy.

Their values stand in presets.toml.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from remodel_fenicsx.body.reductions import AUTO, for_means
from remodel_fenicsx.model.chains import Chain
from remodel_fenicsx.model.laws import COMPLEX_STEP, LAWS
from remodel_fenicsx.schema.settings import COUPLINGS, Properties, in_region
from remodel_fenicsx.schema.tables import fault, quoted
from remodel_fenicsx.schema.text import merged, put

if TYPE_CHECKING:
    from pydantic import BaseModel

# ---------------------------------------------------------------- presets and profiles

_DATA = tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8"))
PRESETS: dict[str, dict[str, dict[str, object]]] = {
    name: {shape: merged(merged(_DATA["method"], body), preset["changes"]) for shape, body in _DATA["bodies"].items()}
    for name, preset in _DATA["presets"].items()
}
"""Preset name -> shape -> scene keys; they lie under the keys of the scene that names the preset."""

PRESET_NOTES: dict[str, str] = {name: preset["note"] for name, preset in _DATA["presets"].items()}


DEFAULT_LAW = "tensor"


def default_method(values: Mapping[str, object]) -> dict[str, Any]:
    """What lies under the keys of a scene without a preset: the law, and what goes with the law that it has."""
    is_default = said(values, "remodeling", "law") in (None, DEFAULT_LAW)
    return _DATA["presets"]["consistent"]["changes"] if is_default else {}


@dataclass(frozen=True)
class Profile:
    """How much accuracy a run shall have: settings, with the error and cost that were measured on the artery."""

    values: dict[str, object]
    degrees: float
    percent: float
    seconds: float
    cells: str
    is_for_means: bool = False

    def in_words(self, name: str) -> str:
        """What it sets, and its measured error and cost."""
        return (
            f"profile {name!r}: {self.settings_in_words()}. Measured on the artery of {self.cells} cells: error of the "
            f"fibre angle {self.degrees:g} degrees, of the radii {self.percent:g} %, processor time {self.seconds:g} s "
            "(docs/speed_and_accuracy.md)"
        )

    def settings_in_words(self) -> str:
        """The keys that it sets."""
        settings = ", ".join(f"{key} = {value}" for key, value in self.values.items())
        if self.is_for_means:
            settings += (
                " or, of a tube, sector with cells.antithetic: their means over seeds are nearly those of the whole"
            )
        return settings

    def settings(self, scene: Any) -> dict[str, object]:
        """Its values for a scene, by dotted key."""
        found = dict(self.values)
        if self.is_for_means and (part := for_means(scene)) != AUTO:
            found |= {"model.kinematics": part, "cells.antithetic": True}  # of fewer cells each draw scatters more
        return found


PROFILES, RANDOM_CELLS = (
    {name: Profile(**one) for name, one in _DATA[table].items()} for table in ("profiles", "random_cells")
)
"""The profiles where cells are isotropic, or given, and where they are random."""


def nested(values: Mapping[str, object]) -> dict[str, Any]:
    """Values by dotted key as tables of a scene."""
    tables: dict[str, object] = {}
    for key, value in values.items():
        put(tables, key, value)
    return tables


def profile_for(name: str, scene: Any) -> Profile:
    """The profile of this name for the cells of a scene."""
    return (RANDOM_CELLS if scene.has_random_cells else PROFILES)[name]


# ---------------------------------------------------------------- numbers that an experiment gives
# An initial stiffness in place of a density of chains, say. A scene may say either, never both; the scene as run has
# the model's own (docs/which_numbers.md).

Values = Mapping[str, Any]
S = TypeVar("S", bound="BaseModel")


def aligned_stiffness(chain: Chain, end_to_end_length: float, contour_length: float) -> float:
    """Stiffness of the network along aligned chains at stretch 1, over the network modulus c."""
    r0 = end_to_end_length
    ahead = complex(r0, COMPLEX_STEP)
    slope = (chain.stiffness(ahead, contour_length) * ahead).imag / COMPLEX_STEP
    return float(r0**2 * (slope + chain.stiffness(r0, contour_length)))


def _chain_density(one: Properties, initial_stiffness: float) -> float:
    tissue = one._replace(material=one.material.model_copy(update={"chain_density": 1.0})).tissue
    chain, r0, length = tissue.chain, tissue.end_to_end_length, tissue.contour_length
    if chain is None or (chain.locks and r0 >= length):  # refused as such
        return one.material.chain_density
    return initial_stiffness / (tissue.network_modulus * aligned_stiffness(chain, r0, length))


class Experiment(NamedTuple):
    """A number of an experiment."""

    table: str
    key: str
    replaces: str
    own: Callable[[Properties, float], float]


EXPERIMENTS = (  # in this order: the density asks for the contour length
    Experiment("material", "locking_stretch", "contour_length", lambda one, v: v * one.cells.end_to_end_length),
    Experiment("material", "initial_stiffness", "chain_density", _chain_density),
    Experiment("remodeling", "half_life", "kappa", lambda one, value: math.log(2) / value),
)


def parts_of(values: Values) -> Iterator[tuple[str, Values]]:
    """What is said of the whole body, under "", and of each region by its name."""
    yield "", values
    regions = values.get("regions")
    for name, region in regions.items() if isinstance(regions, Mapping) else ():
        if isinstance(region, Mapping):
            yield name, region


def with_part(values: Values, name: str, over: Values) -> dict[str, Any]:
    """The values with others laid over what is said of the whole body, or of a region."""
    return merged(values, {"regions": {name: over}} if name else over)


def check_exclusive(own: Values) -> None:
    """Refuse a number of an experiment beside what it replaces."""
    for name, part in parts_of(own):
        for experiment in EXPERIMENTS:
            value, key = said(part, experiment.table, experiment.key), f"{place_of(name)}{experiment.table}"
            if value is not None and said(part, experiment.table, experiment.replaces) is not None:
                rule = f"{key}.{experiment.replaces} is there too; one of them is enough"
                raise fault(rule, f"{key}.{experiment.key}", value)


def with_own_numbers(part: S, properties: Callable[[S], Properties]) -> S:
    """A scene, or a region, with the model's own numbers in place of those of experiments."""
    for table, key, replaces, own in EXPERIMENTS:
        keys = getattr(part, table)
        if (value := getattr(keys, key)) is not None:
            numbers = {key: None, replaces: own(properties(part), value)}
            part = part.model_copy(update={table: keys.model_copy(update=numbers)})
    return part


def without_coupling(base: dict[str, Any], over: Mapping[str, object]) -> None:
    """Take out of the values a coupling that extrapolates where what lies over them has a law without a target."""
    law, coupling = str(said(over, "remodeling", "law")), str(said(base, "remodeling", "coupling"))
    if law in LAWS and LAWS[law].target is None and coupling in COUPLINGS and COUPLINGS[coupling].needs_a_target:
        base["remodeling"] = {key: value for key, value in base["remodeling"].items() if key != "coupling"}


def without_replaced(values: dict[str, Any], changed: Collection[str]) -> None:
    """Take out of the values what changed numbers of experiments replace, and a coupling made for another law."""
    if "remodeling.law" in changed and "remodeling.coupling" not in changed:
        without_coupling(values, values)
    for name, part in parts_of(values):
        for table, key, replaces, *_ in EXPERIMENTS:
            place = f"{place_of(name)}{table}"
            if f"{place}.{key}" in changed and f"{place}.{replaces}" not in changed:
                part[table].pop(replaces, None)


def place_of(name: str) -> str:
    """What stands before the keys of a region that may have any name."""
    return in_region(name and quoted(str(name)))


def said(part: Values, table: str, key: str) -> Any:
    """What is said at a key of a table, as it was read; None where nothing is."""
    keys = part.get(table)
    return keys.get(key) if isinstance(keys, Mapping) else None
