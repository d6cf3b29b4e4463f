"""Presets of published models, profiles of accuracy, and material parameters in experimental form.

Values of presets and profiles are in presets.toml.
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
from remodel_fenicsx.schema.tables import validation_error, quoted
from remodel_fenicsx.schema.text import merge_nested, set_nested

if TYPE_CHECKING:
    from pydantic import BaseModel

# ---------------------------------------------------------------- presets and profiles

_DATA = tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8"))
PRESETS: dict[str, dict[str, dict[str, object]]] = {
    name: {
        shape: merge_nested(merge_nested(_DATA["method"], body), preset["changes"])
        for shape, body in _DATA["bodies"].items()
        if shape in preset.get("shapes", _DATA["bodies"])
    }
    for name, preset in _DATA["presets"].items()
}
"""Scene keys by preset and shape; a scene's own keys override them."""

PRESET_NOTES: dict[str, str] = {name: preset["note"] for name, preset in _DATA["presets"].items()}


DEFAULT_LAW = "tensor"


def default_method(values: Mapping[str, object]) -> dict[str, Any]:
    """Return the keys of the default law for a scene that sets neither preset nor another law."""
    is_default = said(values, "remodeling", "law") in (None, DEFAULT_LAW)
    return _DATA["presets"]["consistent"]["changes"] if is_default else {}


@dataclass(frozen=True)
class Profile:
    """Settings for a level of accuracy, with error and cost measured on the artery."""

    values: dict[str, object]
    degrees: float
    percent: float
    seconds: float
    cells: str
    is_for_means: bool = False

    def in_words(self, name: str) -> str:
        """Describe the settings, and their measured error and cost."""
        return (
            f"profile {name!r}: {self.settings_in_words()}. Measured on the artery of {self.cells} "
            f"cells: error of the fibre angle {self.degrees:g} degrees, of the radii "
            f"{self.percent:g} %, CPU time {self.seconds:g} s (docs/reliability.md)"
        )

    def settings_in_words(self) -> str:
        """Describe the keys that the profile sets."""
        settings = ", ".join(f"{key} = {value}" for key, value in self.values.items())
        if self.is_for_means:
            settings += (
                " or, for a tube, sector with cells.antithetic (nearly the same means over seeds)"
            )
        return settings

    def settings(self, scene: Any) -> dict[str, object]:
        """Return the profile's values for a scene by dotted key."""
        values = dict(self.values)
        if self.is_for_means and (part := for_means(scene)) != AUTO:
            # A sector has fewer cells, so that each draw scatters more.
            values |= {"model.kinematics": part, "cells.antithetic": True}
        return values


PROFILES, RANDOM_CELLS = (
    {name: Profile(**one) for name, one in _DATA[table].items()}
    for table in ("profiles", "random_cells")
)
"""Profiles for isotropic or prescribed cells, and for random cells."""


def nested(values: Mapping[str, object]) -> dict[str, Any]:
    """Convert values by dotted key to nested tables."""
    tables: dict[str, object] = {}
    for key, value in values.items():
        set_nested(tables, key, value)
    return tables


def profile_for(name: str, scene: Any) -> Profile:
    """Return the profile of this name for the cells of a scene."""
    return (RANDOM_CELLS if scene.has_random_cells else PROFILES)[name]


# ---------------------------------------------------------------- experimental parameters
# For example an initial stiffness in place of a chain density. A scene may set either, never both.
# The scene as run has the model's own parameters (docs/concepts.md).

Values = Mapping[str, Any]
S = TypeVar("S", bound="BaseModel")


def aligned_stiffness(chain: Chain, end_to_end_length: float, contour_length: float) -> float:
    """Return the network's stiffness along aligned chains at stretch 1, over the modulus c."""
    r0 = end_to_end_length
    ahead = complex(r0, COMPLEX_STEP)
    slope = (chain.stiffness(ahead, contour_length) * ahead).imag / COMPLEX_STEP
    return float(r0**2 * (slope + chain.stiffness(r0, contour_length)))


def _chain_density(one: Properties, initial_stiffness: float) -> float:
    tissue = one._replace(material=one.material.model_copy(update={"chain_density": 1.0})).tissue
    chain, r0 = tissue.chain, tissue.end_to_end_length
    length = tissue.contour_length
    if chain is None or (chain.locks and r0 >= length):  # The rules reject this value.
        return one.material.chain_density
    return initial_stiffness / (tissue.network_modulus * aligned_stiffness(chain, r0, length))


class MeasuredParameter(NamedTuple):
    """A parameter in experimental form: its key, and its conversion to the model's parameter."""

    table: str
    key: str
    replaces: str
    own: Callable[[Properties, float], object]


def _lengths(one: Properties, fraction_x: float) -> tuple[float, ...]:
    y, r0 = one.cells.fraction_y or 0.0, one.cells.end_to_end_length
    return tuple(r0 * math.sqrt(max(0.0, part)) for part in (fraction_x, y, 1 - fraction_x - y))


EXPERIMENTS = (  # The order matters: the density needs the contour length.
    MeasuredParameter(
        "material",
        "locking_stretch",
        "contour_length",
        lambda one, v: v * one.cells.end_to_end_length,
    ),
    MeasuredParameter("material", "initial_stiffness", "chain_density", _chain_density),
    MeasuredParameter("remodeling", "half_life", "kappa", lambda one, value: math.log(2) / value),
    MeasuredParameter("cells", "fraction_x", "initial", _lengths),
    MeasuredParameter("cells", "fraction_y", "initial", lambda one, _: one.cells.initial),
)


def parts_of(values: Values) -> Iterator[tuple[str, Values]]:
    """Yield the values of the whole body under "", and of each region under its name."""
    yield "", values
    regions = values.get("regions")
    for name, region in regions.items() if isinstance(regions, Mapping) else ():
        if isinstance(region, Mapping):
            yield name, region


def with_part(values: Values, name: str, over: Values) -> dict[str, Any]:
    """Return the values with changes to the whole body ("") or to a region."""
    return merge_nested(values, {"regions": {name: over}} if name else over)


def check_exclusive(own: Values) -> None:
    """Check that no experimental parameter is set together with the parameter that it replaces."""
    for name, part in parts_of(own):
        for experiment in EXPERIMENTS:
            value, key = (
                said(part, experiment.table, experiment.key),
                f"{region_prefix(name)}{experiment.table}",
            )
            if value is not None and said(part, experiment.table, experiment.replaces) is not None:
                rule = f"{key}.{experiment.replaces} is also set; set only one of them"
                raise validation_error(rule, f"{key}.{experiment.key}", value)


def with_own_numbers(part: S, properties: Callable[[S], Properties]) -> S:
    """Replace the experimental parameters of a scene or region by the model's own."""
    for table, key, replaces, own in EXPERIMENTS:
        keys = getattr(part, table)
        if (value := getattr(keys, key, None)) is not None:
            numbers = {key: None, replaces: own(properties(part), value)}
            part = part.model_copy(update={table: keys.model_copy(update=numbers)})
    return part


def without_coupling(base: dict[str, Any], over: Mapping[str, object]) -> None:
    """Remove an extrapolating coupling from `base` if the law in `over` has no target."""
    law, coupling = str(said(over, "remodeling", "law")), str(said(base, "remodeling", "coupling"))
    if (
        law in LAWS
        and LAWS[law].target is None
        and coupling in COUPLINGS
        and COUPLINGS[coupling].needs_a_target
    ):
        base["remodeling"] = {
            key: value for key, value in base["remodeling"].items() if key != "coupling"
        }


def without_replaced(values: dict[str, Any], changed: Collection[str]) -> None:
    """Remove values that experimental parameters replace, and a coupling unsuited to the law."""
    if "remodeling.law" in changed and "remodeling.coupling" not in changed:
        without_coupling(values, values)
    for name, part in parts_of(values):
        for table, key, replaces, *_ in EXPERIMENTS:
            place = f"{region_prefix(name)}{table}"
            if f"{place}.{key}" in changed and f"{place}.{replaces}" not in changed:
                part[table].pop(replaces, None)


def region_prefix(name: str) -> str:
    """Return the prefix of a region's keys, for any name."""
    return in_region(name and quoted(str(name)))


def said(part: Values, table: str, key: str) -> Any:
    """Return the value of a table's key as it was read, or None."""
    keys = part.get(table)
    return keys.get(key) if isinstance(keys, Mapping) else None
