"""The tangent of an energy by its invariants: the same number as by differentiating twice, and in fewer operations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import basix.ufl
import ffcx.compiler
import ffcx.options
import numpy as np
import pytest
import ufl
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from remodel_fenicsx.fem.assembly import invariants, second_derivative
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import REPULSIONS, Tissue

MESH = ufl.Mesh(basix.ufl.element("P", "hexahedron", 1, shape=(3,)))
SPACE = ufl.FunctionSpace(MESH, basix.ufl.element("P", "hexahedron", 1, shape=(3,)))
U, V, D = (ufl.Coefficient(SPACE) for _ in range(3))  # unknown, and the two directions
F = ufl.Identity(3) + ufl.grad(U)
GRADIENTS = dict(
    zip((U, V, D), np.random.default_rng(4).uniform(-0.15, 0.15, (3, 3, 3)), strict=True)
)


def tissue_energy(repulsion: str, *weights: float) -> Any:
    """Of cells with axes of their own, and shares that add up to one."""
    rng, cells = np.random.default_rng(5), []
    for weight in weights:
        axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        cells.append(
            UnitCell(ufl.as_vector(rng.uniform(0.4, 0.7, 3)), ufl.as_matrix(axes.tolist()), weight)
        )
    return Tissue(3.0, 2.0, 1.6, 1.594, 1.0, repulsion=REPULSIONS[repulsion]).strain_energy(
        F, cells
    )


ENERGIES: dict[str, Callable[[], Any]] = {
    "paper": lambda: tissue_energy("axes", 1.0),
    "two shares": lambda: tissue_energy("axes", 0.3, 0.7),
    "r^2 outside of a root too": lambda: tissue_energy("length", 1.0),
    "trace": lambda: ufl.tr(F.T * F) ** 2 * ufl.ln(ufl.det(F)),
    "of another kind": lambda: ufl.exp(F[0, 1]) * ufl.det(F) ** 3,
}


def expanded(expression: Any) -> Any:
    return apply_derivatives(apply_algebra_lowering(expression))


def value(expression: Any) -> float:
    """Of an expanded expression, where the functions are linear."""

    def of(gradient: np.ndarray) -> Callable[..., Any]:
        return lambda x, derivatives=(): (
            tuple(gradient[:, derivatives[0]]) if derivatives else tuple(gradient @ x)
        )

    return float(
        expression((0.3, 0.2, 0.1), {name: of(gradient) for name, gradient in GRADIENTS.items()})
    )


@pytest.mark.parametrize("name", list(ENERGIES))
def test_it_is_the_derivative_of_the_derivative(name: str) -> None:
    energy = ENERGIES[name]()
    assert bool(invariants(energy, U)) == (name != "of another kind")
    plain = expanded(ufl.derivative(ufl.derivative(energy, U, V), U, D))
    (integral,) = second_derivative(energy * ufl.dx, U, V, D).integrals()
    assert value(expanded(integral.integrand())) == pytest.approx(value(plain), rel=1e-12)


def test_it_takes_less_than_half_of_the_operations() -> None:
    """Of the kernel at a quadrature point: a third."""
    test, trial = ufl.TestFunction(SPACE), ufl.TrialFunction(SPACE)
    energy = ENERGIES["paper"]() * ufl.dx(degree=2)
    forms = [
        second_derivative(energy, U, test, trial),
        ufl.derivative(ufl.derivative(energy, U, test), U, trial),
    ]
    options = ffcx.options.get_options()
    ours, plain = (
        str(ffcx.compiler.compile_ufl_objects([form], options)).count("double sv_")
        for form in forms
    )
    assert 0 < ours < plain / 2
