"""Numbers that an experiment gives, in place of the model's own: an initial stiffness for a density of chains, say.

A scene may say either, never both; the scene as run has the model's own (docs/which_numbers.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from remodel_fenicsx.model.chains import BOLTZMANN_CONSTANT, CHAINS, Chain
from remodel_fenicsx.schema.tables import fault, is_number, quoted
from remodel_fenicsx.settings import STRESS_UNITS, Cells, Material, Remodeling

Values = Mapping[str, Any]
Others = Callable[[str, str], Any]  # value of a table's key, where it is one that can be counted with
_TABLES = {"material": Material, "cells": Cells, "remodeling": Remodeling}
_COMPLEX_STEP = 1e-30  # its square vanishes beside 1: the derivative is exact to rounding


class _NotThere(Exception):
    """Another value is at fault; its own table says how."""


def aligned_stiffness(chain: Chain, end_to_end_length: float, contour_length: float) -> float:
    """Stiffness of the network along aligned chains at stretch 1, over the network modulus c.

    Chains and repulsion have the nominal stress P = c r0 (g r - g(r0) r0 / lambda) with r = lambda r0 (eqs. 4, 7), so
    dP/dlambda = c r0^2 (d(g r)/dr + g) at r0.

    Parameters
    ----------
    chain
        The law of a chain.
    end_to_end_length, contour_length
        r0 and L, in link lengths.
    """
    r0 = end_to_end_length
    ahead = complex(r0, _COMPLEX_STEP)
    slope = (chain.stiffness(ahead, contour_length) * ahead).imag / _COMPLEX_STEP
    return float(r0**2 * (slope + chain.stiffness(r0, contour_length)))


def _contour_length(locking_stretch: float, others: Others) -> float:
    return locking_stretch * float(others("cells", "end_to_end_length"))


def _chain_density(initial_stiffness: float, others: Others) -> float:
    def number(key: str, table: str = "material") -> float:
        return float(others(table, key))

    name, unit = others("material", "chain"), others("material", "stress_unit")
    r0, contour_length = number("end_to_end_length", "cells"), number("contour_length")
    if name not in CHAINS or unit not in STRESS_UNITS or r0 >= contour_length:
        raise _NotThere
    modulus = initial_stiffness * STRESS_UNITS[unit] / aligned_stiffness(CHAINS[name], r0, contour_length)
    k_theta = BOLTZMANN_CONSTANT * number("temperature")
    return 4 * number("persistence_length") * modulus / (number("energy_factor") * k_theta)


def _kappa(half_life: float, others: Others) -> float:
    return math.log(2) / half_life


class Experiment(NamedTuple):
    """A number of an experiment.

    Attributes
    ----------
    table, key
        Under which a scene has it.
    replaces
        The model's own key of the same table.
    lowest
        The number is above it.
    own
        The model's own number, of this one and of other values.
    """

    table: str
    key: str
    replaces: str
    lowest: float
    own: Callable[[float, Others], float]


EXPERIMENTS = (  # in this order: the density asks for the contour length
    Experiment("material", "locking_stretch", "contour_length", 1.0, _contour_length),
    Experiment("material", "initial_stiffness", "chain_density", 0.0, _chain_density),
    Experiment("remodeling", "half_life", "kappa", 0.0, _kappa),
)


def check_exclusive(own: Values) -> None:
    """Refuse a number of an experiment beside what it replaces.

    Parameters
    ----------
    own
        What the scene itself says, without what lies under it.

    Raises
    ------
    SceneError
        One line that names both keys.
    """
    for name, part in _parts(own):
        place = _place(name)
        for table, key, replaces, *_ in EXPERIMENTS:
            value = _of(part, table, key)
            if value is not None and _of(part, table, replaces) is not None:
                raise fault(
                    f"{place}{table}.{replaces} is there too; one of them is enough", f"{place}{table}.{key}", value
                )


def with_own_numbers(values: Values) -> dict[str, Any]:
    """The values with the model's own numbers in place of those of experiments.

    What cannot be counted with, here or in the values that are asked for, stays: its table refuses it.

    Parameters
    ----------
    values
        Of a whole scene, without units.
    """
    found = {**values}
    for name, part in _parts(values):
        for experiment in EXPERIMENTS:
            part = _with_own_number(experiment, part, found)
        if name is None:
            found = {**found, **part}
        else:
            found["regions"] = {**found["regions"], name: part}
    return found


def without_replaced(values: dict[str, Any], changed: Iterable[str]) -> None:
    """Take out of the values what changed numbers of experiments replace.

    Parameters
    ----------
    values
        Every value of a scene, changed in place.
    changed
        Dotted keys that have been set.
    """
    changed = set(changed)
    for name, part in _parts(values):
        place = _place(name)
        for table, key, replaces, *_ in EXPERIMENTS:
            if f"{place}{table}.{key}" in changed and f"{place}{table}.{replaces}" not in changed:
                part[table].pop(replaces, None)


def _parts(values: Values) -> Iterator[tuple[Any, Any]]:
    """What is said of the whole body, under None, and of each region by its name."""
    yield None, values
    regions = values.get("regions")
    for name, region in regions.items() if isinstance(regions, Mapping) else ():
        if isinstance(region, Mapping):
            yield name, region


def _place(name: Any) -> str:
    """What stands before the keys of its tables."""
    return "" if name is None else f"regions.{quoted(str(name))}."


def _of(part: Values, table: str, key: str) -> Any:
    keys = part.get(table)
    return keys.get(key) if isinstance(keys, Mapping) else None


def _with_own_number(experiment: Experiment, part: Values, body: Values) -> Values:
    table, key, replaces, lowest, own = experiment
    value = _of(part, table, key)
    if not is_number(value) or value <= lowest:
        return part

    def others(table: str, key: str) -> Any:
        said = (_of(part, table, key), _of(body, table, key), _TABLES[table].model_fields[key].default)
        found = next(value for value in said if value is not None)
        if not isinstance(found, str) and not (is_number(found) and found > 0):
            raise _NotThere
        return found

    try:
        number = own(value, others)
    except (_NotThere, ValueError, OverflowError, ZeroDivisionError):
        return part
    keys = {name: value for name, value in part[table].items() if name != key}
    return {**part, table: {**keys, replaces: number}}
