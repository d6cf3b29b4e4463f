"""The strain energy in UFL: its stresses against eq. (7) typed by hand, its invariances, its derivatives."""

from __future__ import annotations

import basix.ufl
import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.mesh
import numpy as np
import numpy.typing as npt
import pytest
import ufl
from mpi4py import MPI

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.quadrature import expression_values
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.schema.settings import Material
from tests.parts import random_rotations
from tests.reference.radial import secant_stiffness

Array = npt.NDArray[np.float64]

R0 = 1.0
G0 = secant_stiffness(np.array(R0), 1.594)
MATERIAL = Material()
AS_PRINTED = Material(energy_factor=4)
POINTS_PER_CELL = 8
CASES = ["isotropic", "transversely isotropic", "orthotropic", "shorter than r0"]


def stress_by_hand(F: Array, l: Array, n: Array, omega: int = 1) -> Array:  # noqa: E741
    """Eq. (7) with erratum 5, parameters of the tendon; F, n (points, 3, 3), rows of n are the axes; l (points, 3)."""
    lame_lambda, lame_mu, k, theta, chains, persistence_length = (
        27.293,
        3.103,
        1.381e-23,
        310.0,
        2e21,
        1.365,
    )
    J = np.linalg.det(F)[:, None, None]
    b = F @ np.swapaxes(F, 1, 2)
    deformed = n @ np.swapaxes(F, 1, 2)
    dyads = deformed[:, :, :, None] * deformed[:, :, None, :]
    invariants = np.sum(deformed**2, axis=2)
    r = np.sqrt(np.sum(l**2 * invariants, axis=1))[:, None, None]
    c = omega * k * theta * chains / (4 * persistence_length)
    matrix = ((lame_lambda * np.log(J) - lame_mu) * np.eye(3) + lame_mu * b) / J
    chain = c / J * secant_stiffness(r, 1.594) * np.sum((l**2)[:, :, None, None] * dyads, axis=1)
    repulsion = -c / J * G0 * np.sum((l**2 / invariants)[:, :, None, None] * dyads, axis=1)
    return matrix + chain + repulsion


class Points:
    """W, S and the Cauchy stress for omega = 1 and 4 at the 64 quadrature points of eight cells, F, l, n free."""

    def __init__(self) -> None:
        self.mesh = dolfinx.mesh.create_unit_cube(
            MPI.COMM_SELF, 2, 2, 2, dolfinx.mesh.CellType.hexahedron
        )
        self.count = 8 * POINTS_PER_CELL
        self.F, self.l, self.n = self.function((3, 3)), self.function((3,)), self.function((3, 3))
        outputs = []
        for material in (MATERIAL, AS_PRINTED):
            cell, tissue = [UnitCell(self.l, self.n)], material.tissue(R0)
            tensors = tissue.stresses(self.F, cell)
            outputs.append(tissue.strain_energy(self.F, cell))
            outputs += [
                t[i, j]
                for t in (tensors.second_piola_kirchhoff, tensors.cauchy)
                for i in range(3)
                for j in range(3)
            ]
        points, _ = basix.make_quadrature(basix.CellType.hexahedron, 2)
        self.expression = jit.expression(ufl.as_vector(outputs), points)

    def function(self, shape: tuple[int, ...]) -> dolfinx.fem.Function:
        element = basix.ufl.quadrature_element("hexahedron", value_shape=shape, degree=2)
        return dolfinx.fem.Function(dolfinx.fem.functionspace(self.mesh, element))

    def evaluate(
        self, F: Array, l: Array, n: Array
    ) -> dict[int, tuple[Array, Array, Array]]:  # noqa: E741
        """omega -> (W, S, sigma); fewer points than there are are repeated."""
        for function, values in (self.F, F), (self.l, l), (self.n, n):
            function.x.array[:] = np.resize(values, (self.count, *values.shape[1:])).ravel()
        elements = np.arange(8, dtype=np.int32)
        result = expression_values(self.expression, self.mesh, elements, POINTS_PER_CELL).reshape(
            self.count, 2, 19
        )[: len(F)]
        return {
            omega: (
                result[:, i, 0],
                result[:, i, 1:10].reshape(-1, 3, 3),
                result[:, i, 10:].reshape(-1, 3, 3),
            )
            for i, omega in enumerate((1, 4))
        }


@pytest.fixture(scope="module")
def points() -> Points:
    return Points()


def random_state(case: str, count: int = 64) -> tuple[Array, Array, Array]:
    """Random F with J > 0 and r < L, cell dimensions of the case, random orthonormal axes."""
    rng = np.random.default_rng(CASES.index(case))
    F = np.eye(3) + 0.15 * rng.normal(size=(10 * count, 3, 3))
    n = np.linalg.qr(rng.normal(size=(10 * count, 3, 3)))[0]
    l = np.abs(rng.normal(size=(10 * count, 3)))  # noqa: E741
    l /= np.linalg.norm(l, axis=1, keepdims=True)  # noqa: E741
    if case == "isotropic":
        l[:] = 1 / np.sqrt(3)
    elif case == "transversely isotropic":
        l[:] = [1.0, 0.0, 0.0]
    elif case == "shorter than r0":
        l *= rng.uniform(0.71, 1.0, (10 * count, 1))  # noqa: E741
    r = np.sqrt(np.sum((l[:, :, None] * n @ np.swapaxes(F, 1, 2)) ** 2, axis=(1, 2)))
    good = (np.linalg.det(F) > 0.4) & (r < 0.95 * 1.594)
    assert np.sum(good) > count
    return F[good][:count], l[good][:count], n[good][:count]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("omega", [1, 4])
def test_energy_on_arrays_has_the_stress_of_eq_7(points: Points, case: str, omega: int) -> None:
    """A material point without forms: W, and P = dW/dF by complex steps; on one cell and on two shares of it."""
    F, l, n = random_state(case)  # noqa: E741
    tissue = Material(energy_factor=omega).tissue(R0)
    energy = tissue.strain_energy(F, [UnitCell(l, n)])
    np.testing.assert_allclose(energy, points.evaluate(F, l, n)[omega][0], rtol=1e-12, atol=1e-12)
    for cells in ([UnitCell(l, n)], [UnitCell(l, n, 0.3), UnitCell(l, n, 0.7)]):
        first = np.empty_like(F)
        for i, j in np.ndindex(3, 3):
            step = np.zeros((3, 3), complex)
            step[i, j] = 1e-30j
            first[:, i, j] = tissue.strain_energy(F + step, cells).imag / 1e-30
        cauchy = first @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
        np.testing.assert_allclose(cauchy, stress_by_hand(F, l, n, omega), rtol=1e-10, atol=1e-11)


def test_energy_of_the_matrix_and_of_the_undeformed_network() -> None:
    """What no stress shows: the matrix alone has none at F = I, and only psi of eq. (4b) is left of the network."""
    F, l, n = random_state("orthotropic")  # noqa: E741
    J = np.linalg.det(F)
    matrix = (
        27.293 / 2 * np.log(J) ** 2
        + 3.103 / 2 * (np.sum(F**2, axis=(1, 2)) - 3)
        - 3.103 * np.log(J)
    )
    alone = Material(chain_density=0.0).tissue(R0)
    assert alone.locking_length is None
    np.testing.assert_allclose(
        alone.strain_energy(F, [UnitCell(l, n)]), matrix, rtol=1e-13, atol=1e-13
    )
    x, big_l = 1 / 1.594, 1.594
    psi = 1.381e-23 * 310.0 * 2e21 / (4 * 1.365) * big_l / 4 * (2 * x**2 + 1 / (1 - x) - x)
    undeformed = MATERIAL.tissue(R0).strain_energy(
        np.broadcast_to(np.eye(3), F.shape), [UnitCell(l, n)]
    )
    np.testing.assert_allclose(undeformed, psi, rtol=1e-13)


def test_stiffness_of_matrix_and_network() -> None:
    """lambda + 2 mu + c (r^2 df/dr + g(r0) r0^2), f = r/L + 1/(4 (1-r/L)^2) - 1/4 the chain's force."""
    big_l, matrix, c = 1.594, 27.293 + 2 * 3.103, 1.381e-23 * 310.0 * 2e21 / (4 * 1.365)
    r = big_l * np.array([0.1, 1 / big_l, 0.9, 1 - 1e-4])
    slope = 1 / big_l + 1 / (2 * big_l * (1 - r / big_l) ** 3)
    np.testing.assert_allclose(
        MATERIAL.tissue(R0).stiffness(r), matrix + c * (r**2 * slope + G0), rtol=1e-5
    )
    assert Material(chain_density=0.0).tissue(R0).stiffness(1.0) == matrix


def test_energy_increment_is_the_slope_from_the_old_to_the_new_cell() -> None:
    """By central differences along the straight way between two cells, of which r^2 and W_rep are the shares."""
    F, l, n = random_state("orthotropic")  # noqa: E741
    rng = np.random.default_rng(8)
    old, new = UnitCell(l, n), UnitCell(
        l[rng.permutation(len(l))], random_rotations(np.random.default_rng(9), len(l))
    )
    tissue, h = MATERIAL.tissue(R0), 1e-5
    energies = [
        tissue.strain_energy(F, [UnitCell(*old[:2], 1 - theta), UnitCell(*new[:2], theta)])
        for theta in (h, -h)
    ]
    slope = (energies[0] - energies[1]) / (2 * h)
    found = tissue.energy_increment(F, old, new)
    assert np.abs(found).max() > 0.5
    np.testing.assert_allclose(found, slope, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("omega", [1, 4])
def test_stress_is_eq_7(points: Points, case: str, omega: int) -> None:
    F, l, n = random_state(case)  # noqa: E741
    _, second, cauchy = points.evaluate(F, l, n)[omega]
    expected = stress_by_hand(F, l, n, omega)
    pushed = F @ second @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
    size = np.max(np.abs(expected), axis=(1, 2))
    for stress in (cauchy, pushed):
        assert np.max(np.max(np.abs(stress - expected), axis=(1, 2)) / size) < 1e-12


@pytest.mark.parametrize("case", CASES)
def test_objectivity_and_the_axes_as_the_only_directions(points: Points, case: str) -> None:
    """W(QF) = W(F), sigma(QF) = Q sigma Q^T, S(QF) = S(F); W(F Q^T; Q n) = W(F; n) with the same sigma."""
    F, l, n = random_state(case)  # noqa: E741
    Q = random_rotations(np.random.default_rng(9), len(F))
    back = np.swapaxes(Q, 1, 2)
    turned, rested = points.evaluate(Q @ F, l, n), points.evaluate(F @ back, l, n @ back)
    for omega, (energy, second, cauchy) in points.evaluate(F, l, n).items():
        np.testing.assert_allclose(turned[omega][0], energy, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(turned[omega][1], second, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(turned[omega][2], Q @ cauchy @ back, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(rested[omega][0], energy, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rested[omega][2], cauchy, rtol=1e-11, atol=1e-11)
