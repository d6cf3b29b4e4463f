"""What lies under or over the keys of a scene that names it: the presets of the paper, and profiles of accuracy.

Source: E. Kuhl, G. A. Holzapfel, J. Mater. Sci. 42 (2007) 8811-8823; docs/theory.md has the equations as implemented.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from remodel_fenicsx.body.reductions import AUTO, for_means
from remodel_fenicsx.model.chains import Chain
from remodel_fenicsx.model.laws import COMPLEX_STEP, LAWS
from remodel_fenicsx.schema.settings import COUPLINGS, Properties, in_region
from remodel_fenicsx.schema.tables import fault, quoted
from remodel_fenicsx.schema.text import merged, put

if TYPE_CHECKING:
    from pydantic import BaseModel

# ---------------------------------------------------------------- without a preset

DEFAULT_LAW = "tensor"


def default_method(values: Mapping[str, object]) -> dict[str, dict[str, object]]:
    """What lies under the keys of a scene without a preset: the law, and what goes with the law that it has."""
    remodeling = values.get("remodeling")
    law = remodeling.get("law", DEFAULT_LAW) if isinstance(remodeling, Mapping) else DEFAULT_LAW
    if law != DEFAULT_LAW:
        return {}
    return {"material": {"repulsion": "log"}, "remodeling": {"law": DEFAULT_LAW, "coupling": "extrapolated"}}


# ---------------------------------------------------------------- presets


def _printed_method(
    geometry: dict[str, float],
    loads: dict[str, object],
    end: float,
    material: dict[str, float],
    cells: dict[str, object],
) -> dict[str, object]:
    """The paper's method on one of its bodies, every choice spelled out; how systems are solved is none of them."""
    common_material = {
        "lame_lambda": 27.293,
        "lame_mu": 3.103,
        "temperature": 310.0,
        "energy_factor": 1,
        "matrix": "neo-hookean",
        "chain": "wormlike",
        "repulsion": "axes",
        "stress_unit": "Pa",
    }
    return {
        "geometry": geometry,
        "mesh": {"refinement": 1, "element": "hexahedron", "degree": 1, "formulation": "displacement"},
        "model": {"kinematics": "full"},
        "material": common_material | material,
        "cells": {"end_to_end_length": 1.0} | cells,
        "loads": loads,
        "remodeling": {
            "driver": "cauchy",
            "law": "explicit",
            "frame": "spatial",
            "pairing": "sorted",
            "coupling": "staggered",
            "kappa": 0.025,
        },
        "time": {"end": end, "step": 1.0},
    }


def _load(value: float, end_of_ramp: float) -> dict[str, object]:
    return {"value": value, "ramp": [[0.0, 0.0], [end_of_ramp, 1.0]]}


_STIFFER_CHAINS = {"chain_density": 7.0e21, "contour_length": 2.125, "persistence_length": 1.82}
_CHAINS = {"chain_density": 2.0e21, "contour_length": 1.594, "persistence_length": 1.365}

_PAPER = {
    "cube": _printed_method(
        {"side": 1.0},
        {"force": _load(10.0, 10.0)},
        100.0,
        _STIFFER_CHAINS,
        {"initial": "isotropic", "axes": "global"},
    ),
    "tendon": _printed_method(
        {"length": 10.0, "area": 10.0},
        {"force": _load(300.0, 12.0)},
        150.0,
        _CHAINS,
        {"initial": "random", "axes": "global", "seed": 1},
    ),
    "tube": _printed_method(
        {"inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
        {"pressure": _load(4.8, 25.0), "elongation": _load(0.1, 25.0)},
        150.0,
        _CHAINS,
        {"initial": "random", "axes": "cylindrical", "seed": 1},
    ),
    "sheet": _printed_method(
        {"length_x": 10.0, "length_y": 10.0, "thickness": 1.0},
        {"force_x": _load(50.0, 10.0), "force_y": _load(25.0, 10.0)},
        100.0,
        _CHAINS,
        {"initial": "isotropic", "axes": "global"},
    ),
}

# Lengths in nm. r0 is the root mean square end-to-end length of the free chain,
# sqrt(2 A_p L (1 - A_p/L (1 - e^(-L/A_p)))), and the density makes c g(r0) r0^2, the stress of the chains
# at rest, that of the paper's tendon and artery.
_MEASURED_COLLAGEN = {
    "material": {"chain_density": 9.0e20, "contour_length": 309.0, "persistence_length": 14.5},
    "cells": {"end_to_end_length": 92.4},
}


def _consistent(scene: dict[str, object]) -> dict[str, object]:
    changes = {"law": "tensor", "frame": "material", "coupling": "extrapolated"}
    found = merged(scene, {"material": {"repulsion": "log"}, "remodeling": changes})
    del found["remodeling"]["pairing"]
    return found


PRESETS: dict[str, dict[str, dict[str, object]]] = {
    "kuhl-holzapfel-2007": _PAPER,
    "consistent": {shape: _consistent(scene) for shape, scene in _PAPER.items()},
    "sun-2002": {shape: merged(scene, _MEASURED_COLLAGEN) for shape, scene in _PAPER.items()},
}
"""Preset name -> shape -> scene keys; they lie under the keys of the scene that names the preset."""

PRESET_NOTES = {
    "kuhl-holzapfel-2007": "The printed method on the three bodies of the paper: Fig. 5 (cube), Fig. 6 (tendon), "
    "Figs. 7 to 11 (tube); and on a sheet, which the paper has not. The frame is 'spatial', as printed in eq. (9).",
    "consistent": "The paper's bodies and parameters with a law and an energy that depend on the structure tensor "
    "alone (docs/theory.md, The consistent variant). It is of second order in the time step.",
    "sun-2002": "The printed method with collagen I as measured with optical tweezers (paper, Remark 2): contour "
    "length 309 nm, persistence length 14.5 nm, all chain lengths in nm. End-to-end length (that of a free chain) and "
    "chain density (it gives the same initial stiffness of the network) are choices of this project, not of the paper.",
}

# ---------------------------------------------------------------- profiles


@dataclass(frozen=True)
class Profile:
    """How much accuracy a run shall have: settings, with the error and cost that were measured on the artery."""

    values: dict[str, object]
    degrees: float
    percent: float
    seconds: float
    cells: str = "isotropic"
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


def nested(values: Mapping[str, object]) -> dict[str, Any]:
    """Values by dotted key as tables of a scene."""
    tables: dict[str, object] = {}
    for key, value in values.items():
        put(tables, key, value)
    return tables


def _values(refinement: int, degree: int, tolerance: float) -> dict[str, object]:
    values = {"model.kinematics": AUTO, "mesh.refinement": refinement, "mesh.degree": degree, "mesh.formulation": AUTO}
    return values | {"time.tolerance": tolerance}


PROFILES: dict[str, Profile] = {
    "fast": Profile(_values(1, 1, 1.0), 1.4, 0.7, 0.2),
    "balanced": Profile(_values(1, 2, 0.5), 0.5, 0.5, 0.4),
    "reference": Profile(_values(2, 2, 0.1), 0.06, 0.06, 2.0),
}
"""Points of the front of docs/speed_and_accuracy.md; `remodel-fenicsx trade SCENE` measures any scene."""

# Another mesh has other random cells, and with a tolerance each seed has other steps: both stay the scene's own. A
# looser solve adds nothing to their error (docs/speed_and_accuracy.md, A quarter of a tube)
_LOOSE = {"solver.relative_tolerance": 1e-6, "model.kinematics": AUTO, "mesh.formulation": AUTO}
_QUICK = Profile(_LOOSE, 0.8, 0.4, 1.0, "random", is_for_means=True)
RANDOM_CELLS: dict[str, Profile] = {
    "fast": _QUICK,
    "balanced": _QUICK,
    "reference": Profile({"model.kinematics": AUTO, "mesh.formulation": AUTO}, 0.8, 0.4, 4.1, "random"),
}
"""The profiles where cells are random."""


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


def with_part(values: Values, name: str, part: Values) -> dict[str, Any]:
    """The values with what is said of the whole body, or of a region, replaced."""
    return {**values, **(part if name == "" else {"regions": {**values["regions"], name: part}})}


def check_exclusive(own: Values) -> None:
    """Refuse a number of an experiment beside what it replaces."""
    for name, part in parts_of(own):
        for experiment in EXPERIMENTS:
            value, key = _of(part, experiment.table, experiment.key), f"{place_of(name)}{experiment.table}"
            if value is not None and _of(part, experiment.table, experiment.replaces) is not None:
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
    law, coupling = str(_of(over, "remodeling", "law")), str(_of(base, "remodeling", "coupling"))
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


def _of(part: Values, table: str, key: str) -> object:
    keys = part.get(table)
    return keys.get(key) if isinstance(keys, Mapping) else None
