"""The repulsive energy that makes the unloaded tissue stress-free: W_rep = -c/2 g(r0) M, with M in several forms.

`axes` is the paper's (eq. 4c): it sees the axes of a cell. `log` sees the structure tensor A = sum_I l_I^2 n_I (x) n_I
alone: it equals `axes` where C and the cell are coaxial, is isotropic for isotropic cells in every frame, and leaves
C = I stress-free for every A (docs/theory.md, "The consistent variant"). `length` is the simplest function of A; it has
no shear stiffness from isotropic cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import logarithm, mandel
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.operators import component, ln

Array = NDArray[np.float64]


def squared_end_to_end_length(deformation_gradient: Any, cells: Sequence[UnitCell]) -> Any:
    """r^2 = sum_I l_I^2 n_I . C n_I (eq. 5)."""
    return sum(
        cell.weight * component(cell.dimensions, i) ** 2 * stretch
        for cell in cells
        for i, stretch in enumerate(cell.squared_stretches(deformation_gradient))
    )


def axes_sum(deformation_gradient: Any, cells: Sequence[UnitCell], end_to_end_length: Any) -> Any:
    """M = sum_I l_I^2 ln(n_I . C n_I); UFL or arrays."""
    return sum(
        cell.weight * component(cell.dimensions, i) ** 2 * ln(stretch)
        for cell in cells
        for i, stretch in enumerate(cell.squared_stretches(deformation_gradient))
    )


def length_sum(deformation_gradient: Any, cells: Sequence[UnitCell], end_to_end_length: Any) -> Any:
    """M = r0^2 ln(r^2 / r0^2), r^2 = A : C; UFL or arrays."""
    squared = squared_end_to_end_length(deformation_gradient, cells)
    return end_to_end_length**2 * ln(squared / end_to_end_length**2)


def log_sum(deformation_gradient: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Any:
    """M = A : ln C; arrays."""
    C = np.swapaxes(deformation_gradient, -1, -2) @ deformation_gradient
    return (whole_structure_tensor(cells) * logarithm.logarithm(C)).sum(axis=(-1, -2))


def whole_structure_tensor(cells: Sequence[UnitCell]) -> Array:
    """A of a cell, or of its shares with numbers for weights, (n, 3, 3)."""
    total: Array = sum(cell.weight * structure_tensor(cell.dimensions, cell.axes) for cell in cells)  # type: ignore
    return total


def log_derivatives(C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
    """dM/dC (n, 3, 3) and d^2M/dC^2 as Mandel matrices (n, 6, 6) of M = A : ln C, the second on request."""
    values, vectors = logarithm.eigen(C)
    components = logarithm.rotated(A, vectors)
    back = np.swapaxes(vectors, -1, -2)
    first = logarithm.rotated(logarithm.derivative(values, components), back)
    if not second:
        return first, None
    rotation = mandel.congruence(vectors)
    return first, rotation @ logarithm.second_derivative(values, components) @ np.swapaxes(rotation, 1, 2)


@dataclass(frozen=True)
class Repulsion:
    """A form of the repulsive energy.

    Attributes
    ----------
    sum
        M from (F, cells, r0): arrays, and UFL too where there are no `derivatives`.
    derivatives
        Where M is no closed expression for UFL: dM/dC and, on request, d^2M/dC^2 as Mandel matrices from (C, A,
        second), arrays.
    """

    sum: Callable[[Any, Sequence[UnitCell], Any], Any]
    derivatives: Callable[..., tuple[Array, Array | None]] | None = None


REPULSIONS: dict[str, Repulsion] = {
    "axes": Repulsion(axes_sum),
    "log": Repulsion(log_sum, log_derivatives),
    "length": Repulsion(length_sum),
}
