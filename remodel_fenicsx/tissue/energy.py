"""The strain energy of tissue with remodeling collagen, in UFL: the only place where it is written.

Stresses, drivers, residual and tangent follow by differentiation. Per reference volume (docs/theory.md):

    W      = W_iso + W_chn + W_rep
    W_iso  = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J
    W_chn  = c psi(r),  r^2 = sum_I l_I^2 I_I,  I_I = n_I . C n_I = f_I . f_I,  f_I = F n_I
    W_rep  = -c/2 g(r0) sum_I l_I^2 ln I_I
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import ufl

from remodel_fenicsx.tissue.chains import CHAINS
from remodel_fenicsx.scene.parameters import Material


class Cell(NamedTuple):
    """An orthotropic eight-chain unit cell, or a share of one.

    Attributes
    ----------
    dimensions
        l_I, UFL vector of length 3, in link lengths.
    axes
        n_I, UFL tensor of shape (3, 3): row I is the unit vector n_I in the reference configuration.
    weight
        Share of this cell in r^2 and in W_rep. One for a whole cell; a blend of an old and a new cell (weights that add
        up to one) is how a remodeling increment is applied in parts.
    """

    dimensions: Any
    axes: Any
    weight: Any = 1.0

    def squared_stretches(self, deformation_gradient: Any) -> list[Any]:
        """I_I = n_I . C n_I, the squared stretches along the three axes (eq. 5)."""
        fibres = [ufl.dot(deformation_gradient, self.axes[i, :]) for i in range(3)]
        return [ufl.inner(fibre, fibre) for fibre in fibres]


def squared_end_to_end_length(deformation_gradient: Any, cells: Sequence[Cell]) -> Any:
    """r^2 = sum_I l_I^2 n_I . C n_I (eq. 5)."""
    return sum(
        cell.weight * cell.dimensions[i] ** 2 * stretch
        for cell in cells
        for i, stretch in enumerate(cell.squared_stretches(deformation_gradient))
    )


def strain_energy(
    deformation_gradient: Any, cells: Sequence[Cell], material: Material, end_to_end_length: float
) -> Any:
    """W per reference volume (eqs. 3 and 4 with errata 1 and 2), in the material's stress unit.

    Parameters
    ----------
    deformation_gradient
        F, UFL, shape (3, 3).
    cells
        The unit cell: one whole cell, or shares whose weights add up to one.
    material
        Parameters of matrix and chains.
    end_to_end_length
        r0, the initial chain length, a constant of the material (erratum 3), in link lengths.
    """
    F, chain = deformation_gradient, CHAINS[material.chain]
    jacobian = ufl.det(F)
    log_jacobian = ufl.ln(jacobian)
    matrix = (
        material.lame_lambda / 2 * log_jacobian**2
        + material.lame_mu / 2 * (ufl.inner(F, F) - 3)
        - material.lame_mu * log_jacobian
    )
    chains = chain.energy(ufl.sqrt(squared_end_to_end_length(F, cells)), material.contour_length)
    repulsion = (
        -chain.stiffness(end_to_end_length, material.contour_length)
        / 2
        * sum(
            cell.weight * cell.dimensions[i] ** 2 * ufl.ln(stretch)
            for cell in cells
            for i, stretch in enumerate(cell.squared_stretches(F))
        )
    )
    return matrix + material.network_modulus * (chains + repulsion)


class Stresses(NamedTuple):
    """Stress tensors of one state, UFL, shape (3, 3)."""

    first_piola_kirchhoff: Any
    second_piola_kirchhoff: Any
    cauchy: Any


def stresses(
    deformation_gradient: Any, cells: Sequence[Cell], material: Material, end_to_end_length: float
) -> Stresses:
    """P = dW/dF, S = F^-1 P and sigma = P F^T / J (eqs. 6 and 7 with erratum 5), by differentiation of W."""
    F = ufl.variable(deformation_gradient)
    first = ufl.diff(strain_energy(F, cells, material, end_to_end_length), F)
    return Stresses(first, ufl.dot(ufl.inv(F), first), ufl.dot(first, F.T) / ufl.det(F))
