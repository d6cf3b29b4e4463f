"""Cells that answer within a solve: the local Newton method at each point, and the consistent tangent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import resolved
from remodel_fenicsx.model import spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, Derivatives, Driver, FRAMES, Frame, carried_axes
from remodel_fenicsx.model.energy import Matrix, REPULSIONS, Repulsion, Tissue
from remodel_fenicsx.model.laws import Drive, LAWS, Law, Ranked, TurnedOver, TurnoverRule
from remodel_fenicsx.model.laws import by_rank, turned_over_at_the_end


# ---------------------------------------------------------------- the laws, for Newton's method
# What cells a driving tensor makes at the end of a step, with the derivative. Everything is in the eigenbasis of C. The
# tensor X lives where the law looks for its eigenvectors: in material space, or, for a spatial driver and the frame
# `spatial`, in space. The cells themselves are those of `laws`.

Array = NDArray[np.float64]

AGREE = 1e-7
"""Relative difference of two principal values below which nothing is known about a turn in their plane."""


class StepOfCells(NamedTuple):
    """What points know of their cells in a step, in the global basis."""

    law: Law
    drive: Drive
    cells: UnitCell
    structure: Array
    time_old: float
    time_new: float
    turnover: TurnoverRule | None = None

    @property
    def turned_over(self) -> Callable[[Tissue, Array], TurnedOver] | None:
        """Content and natural length at its end from the tissue and r there."""
        rule, duration = self.turnover, self.time_new - self.time_old
        return None if rule is None else lambda tissue, length: turned_over_at_the_end(rule, tissue, length, duration)

    @property
    def is_spatial(self) -> bool:
        """Whether X lives in space."""
        return not self.drive.driver.material and not self.drive.frame.carries_axes

    @property
    def carries_axes(self) -> bool:
        """Whether the principal axes of X are pulled back to those of the cells."""
        return not self.drive.driver.material and self.drive.frame.carries_axes

    @property
    def rate(self) -> Array | float:
        """kappa dt, (n,) or a number."""
        return self.drive.kappa * (self.time_new - self.time_old)


class Response(NamedTuple):
    """Cells in the eigenbasis of C, and the derivatives of their numbers y by X and by U, (n, 6, 6)."""

    cells: LocalCells
    by_tensor: Array | None = None
    by_stretch: Array | None = None


def _lengths(step: StepOfCells, target: Any) -> Array:
    """What a law by rank makes of the lengths; `target` may be complex."""
    drive, law = step.drive, step.law.dimensions
    assert law is not None
    return law(step.cells.dimensions, drive.initial_dimensions, target, drive.kappas, step.time_old, step.time_new)


# ---------------------------------------------------------------- the law for A


def tensor_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """A = A_old + w (r0^2 E - A_old), w = 1 - exp(-kappa s dt): `tensor_law` and its derivative."""
    r0 = np.asarray(step.drive.end_to_end_length)
    towards, old = tensor_law.target(tensor, step.drive.floor), strain.inside(step.structure)
    cells = StructureCells(tensor_law.follow(old, towards, r0, step.rate))
    if not derivatives:
        return Response(cells)
    direction, share = tensor_law.target_derivatives(tensor, step.drive.floor)
    squared, weight = r0**2, -np.expm1(-step.rate * towards.share)
    by_tensor = (squared * weight)[:, None, None] * direction
    by_share = step.rate * np.exp(-step.rate * towards.share)
    way = tensors.to_mandel(squared[:, None, None] * towards.direction - old)
    by_tensor += tensors.dyads(by_share[:, None] * way, share)
    return Response(cells, by_tensor)


# ---------------------------------------------------------------- laws by rank


def ranked_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """Lengths by rank along the framed principal axes of X (`laws.by_rank`), and their derivatives."""
    old = UnitCell(step.cells.dimensions, step.cells.axes @ strain.basis)
    assert step.law.dimensions is not None
    found = by_rank(step.law.dimensions, old, _drive(step, strain, tensor, old), step.time_old, step.time_new)
    cells = OrthotropicCells(found.cells)
    if not derivatives:
        return Response(cells)
    by_tensor: Array = np.zeros((len(tensor), 6, 6))
    by_tensor[:, :3, :3] = _lengths_by_values(step, found)
    by_tensor[:, range(3, 6), range(3, 6)] = _turns_by_tensor(step, found)
    by_stretch = None
    if step.carries_axes:
        by_stretch = np.zeros_like(by_tensor)
        by_turns, by_stretch[:, 3:] = _pulled_back(step, found, strain)
        by_tensor[:, 3:] = by_turns @ by_tensor[:, 3:]
        by_stretch[~found.active] = 0.0
    by_tensor[~found.active] = 0.0
    by_tensor = by_tensor @ tensors.congruence(found.axes)  # X in its own axes from X as it is
    return Response(cells, by_tensor, by_stretch)


def _drive(step: StepOfCells, strain: Strain, tensor: Array, old: UnitCell) -> Drive:
    """What acts at a strain, with a driving tensor."""
    U = np.zeros_like(tensor)
    U[:, range(3), range(3)] = strain.stretches
    axes = carried_axes(U, old.axes) if step.carries_axes else old.axes
    steady = spectral.without_noise(tensor, axes, step.drive.rounding)  # more of it would be a jump of its own
    return step.drive._replace(deformation_gradient=U, tensor=steady, kernels=spectral)


def _lengths_by_values(step: StepOfCells, found: Ranked) -> Array:
    """dl/d(principal values of X), (n, 3, 3): de = (1 - e e) dv+ / |v+|, and the law's slope by a complex step."""
    tiny, r0 = 1e-30, np.reshape(step.drive.end_to_end_length, (-1, 1))
    slope = np.imag(_lengths(step, found.target + 1j * tiny)) / tiny
    e = found.target / r0
    size = np.linalg.norm(np.where(e > 0, found.values, 0.0), axis=1)
    steepness = slope * (r0 / np.where(found.active, size, 1.0)[:, None])
    return steepness[:, :, None] * (np.eye(3) - e[:, :, None] * e[:, None, :]) * (e > 0)[:, None, :]


def _turns_by_tensor(step: StepOfCells, found: Ranked) -> Array:
    """By what the axes of X turn in the planes of `PAIRS`, over the Mandel components of dX there: 1/(v_i - v_j)."""
    i, j = np.transpose(tensors.PAIRS)
    gap = found.values[:, i] - found.values[:, j]
    unknown = AGREE * np.abs(found.values).max(axis=1)
    known = np.abs(gap) > np.maximum(unknown, step.drive.noise)[:, None]
    return np.where(known, np.sqrt(0.5) / np.where(known, gap, 1.0), 0.0)


def _pulled_back(step: StepOfCells, found: Ranked, strain: Strain) -> tuple[Array, Array]:
    """Turns of the axes n of cells by those of the axes m of X and by the Mandel components of dU, each (n, 3, 3)."""
    # n are the rows m U^-1, orthonormalised in the frame's order (`drivers.material_frame`): m U^-1 = L n, L lower
    # triangular in that order. With dm = W m it follows that dn = V n, V_ij = (L^-1 W L - n dU U^-1 n^T)_ij where n_i
    # comes before n_j.
    m, n, u = found.axes, found.cells.axes, strain.stretches[:, None, :]
    carried = n / u
    L, inverse = m @ np.swapaxes(carried, 1, 2), (n * u) @ np.swapaxes(m, 1, 2)
    i, j = (number[:, None] for number in np.transpose(tensors.PAIRS))
    p, q = i.T, j.T
    before: Any = True
    if step.drive.pairing is not spectral.principal:  # as `laws.framed`
        lengths = found.cells.dimensions
        before = lengths[:, i] >= lengths[:, j]

    def by_turns(i: Any, j: Any) -> Array:
        return inverse[:, i, p] * L[:, q, j] - inverse[:, i, q] * L[:, p, j]

    def by_stretch(i: Any, j: Any) -> Array:
        dyads = n[:, i[:, 0], :, None] * carried[:, j[:, 0], None, :]
        return -tensors.to_mandel(dyads + np.swapaxes(dyads, 2, 3)) / 2

    return np.where(before, by_turns(i, j), -by_turns(j, i)), np.where(before, by_stretch(i, j), -by_stretch(j, i))


# ---------------------------------------------------------------- stress of matrix and network on arrays
# With its derivatives by strain and by cells: what a condensed tangent needs. Everything is in the eigenbasis of C,
# where C is diagonal. Symmetric tensors are Mandel vectors, derivatives 6 x 6 matrices (`tensors`). Cells are given by
# six numbers y of their own: the structure tensor itself, or the three lengths and the three turns of an orthotropic
# cell.
#     S = S_matrix + c (g(r) A - g(r0) G),    r^2 = A : C,    G = dM/dC
# With turnover it is m c (g(r/rho)/rho^2 A - g(r0) G), m and rho those at the end of a step as functions of r.
# Points are named tuples of arrays, one entry of each array a point: `at` takes some of them, `put` puts some into
# them.


def at(points: Any, chosen: Any) -> Any:
    """Some of the points, by mask or by number; what is no array is the same at all of them."""
    if isinstance(points, tuple):
        return type(points)(*(at(values, chosen) for values in points))  # type: ignore[call-arg]
    return points[chosen] if isinstance(points, np.ndarray) else points


def put(points: Any, chosen: Any, better: Any) -> None:
    """Put some of the points into all of them."""
    for values, others in zip(points, better, strict=True):
        if isinstance(values, tuple):
            put(values, chosen, others)
        elif isinstance(values, np.ndarray):
            values[chosen] = others


class Strain(NamedTuple):
    """Deformation of n points in the eigenbasis of C."""

    gradient: Array
    squared: Array
    basis: Array

    @classmethod
    def of(cls, gradient: Array) -> Strain:
        """From F."""
        return cls(gradient, *tensors.eigen(np.swapaxes(gradient, 1, 2) @ gradient))

    @property
    def stretches(self) -> Array:
        """Eigenvalues of U, (n, 3)."""
        return np.sqrt(self.squared)

    @property
    def rotation(self) -> Array:
        """R of F = R U in the eigenbasis."""
        turned = tensors.rotated(self.gradient, self.basis)
        return turned / self.stretches[:, None, :]

    @property
    def by_gradient(self) -> Array:
        """dC/dF, (n, 6, 9): dC = dF^T F + F^T dF in the eigenbasis, dF in the global one, row by row."""
        carried, Q = self.gradient @ self.basis, self.basis
        both = _dyads_of_columns(carried, Q, tensors.ROWS, tensors.COLUMNS)
        both += _dyads_of_columns(carried, Q, tensors.COLUMNS, tensors.ROWS)
        return tensors.FACTORS[:, None] * both

    @property
    def turn_by_gradient(self) -> Array:
        """dw/dF, (n, 3, 9), of turns dR = R W: w_ij = ((R^T dF)_ij - (R^T dF)_ji)/(u_i + u_j) in the eigenbasis."""
        u, (i, j) = self.stretches, np.transpose(tensors.PAIRS)
        axes = self.gradient @ self.basis / u[:, None, :]  # R Q
        both = _dyads_of_columns(axes, self.basis, i, j) - _dyads_of_columns(axes, self.basis, j, i)
        return both / (u[:, i] + u[:, j])[:, :, None]

    @property
    def stretch_by_strain(self) -> Array:
        """dU/dC, (n, 6, 6): 1/(u_i + u_j)."""
        u = self.stretches
        return tensors.diagonal(1 / (u[:, :, None] + u[:, None, :]))

    def inside(self, components: Array) -> Array:
        """Components of tensors (n, 3, 3) in the eigenbasis."""
        return tensors.rotated(components, self.basis)

    def outside(self, components: Array) -> Array:
        """Components in the global basis of tensors in the eigenbasis."""
        return tensors.rotated(components, np.swapaxes(self.basis, 1, 2))


def _dyads_of_columns(left: Array, right: Array, i: Any, j: Any) -> Array:
    """Column i of one matrix times column j of another, row by row, for numbers i and j: (n, len(i), 9)."""
    dyads = left[:, :, None, i] * right[:, None, :, j]
    return np.moveaxis(dyads.reshape(len(left), 9, len(i)), 2, 1)


class StructureCells(NamedTuple):
    """Cells of n points in the eigenbasis of C that are their structure tensor: y is A (n, 3, 3)."""

    structure: Array

    def structure_by_cells(self) -> Array:
        """dA/dy, (n, 6, 6): the identity."""
        return np.broadcast_to(np.eye(6), (len(self.structure), 6, 6))


class OrthotropicCells(NamedTuple):
    """Cells with lengths and axes (rows): y is dl, and turns w_ij (`tensors.PAIRS`), dn_i = w n_j, dn_j = -w n_i."""

    cell: UnitCell

    @property
    def structure(self) -> Array:
        """A, (n, 3, 3)."""
        return structure_tensor(self.cell.dimensions, self.cell.axes)

    def to_axes(self) -> Array:
        """Matrix that takes components in the cell's axes to the eigenbasis of C."""
        return tensors.congruence(np.swapaxes(self.cell.axes, 1, 2))

    def structure_by_cells(self) -> Array:
        """dA = 2 l dl n n, and (l_i^2 - l_j^2) across the axes."""
        lengths = self.cell.dimensions
        entries = np.zeros((len(lengths), 6))
        entries[:, :3] = 2 * lengths
        for row, (i, j) in enumerate(tensors.PAIRS, start=3):
            entries[:, row] = np.sqrt(2) * (lengths[:, i] ** 2 - lengths[:, j] ** 2)
        return self.to_axes() * entries[:, None, :]


LocalCells = StructureCells | OrthotropicCells


class Terms(NamedTuple):
    """G = dM/dC (n, 3, 3), and its derivatives by cells and by C, (n, 6, 6); None where they were not asked for."""

    value: Array
    by_cells: Array | None
    by_strain: Array | None


def log_terms(squared: Array, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = A : ln C."""
    A, quotients = cells.structure, tensors.first_divided_differences(squared)
    if not derivatives:
        return Terms(quotients * A, None, None)
    by_cells = quotients[:, tensors.ROWS, tensors.COLUMNS][:, :, None] * cells.structure_by_cells()
    return Terms(quotients * A, by_cells, tensors.second_derivative(squared, A))


def length_terms(squared: Array, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = r0^2 ln(A : C / r0^2)."""
    A, scale = cells.structure, r0[:, None, None] ** 2
    length = np.einsum("nii,ni->n", A, squared)[:, None, None]  # r^2
    if not derivatives:
        return Terms(scale * A / length, None, None)
    a, by_cells = tensors.to_mandel(A), cells.structure_by_cells()
    across = tensors.dyads(a, np.einsum("na,nab->nb", tensors.on_diagonal(squared), by_cells))
    return Terms(
        scale * A / length,
        scale * (by_cells / length - across / length**2),
        -scale * tensors.dyads(a, a) / length**2,
    )


def axes_terms(squared: Array, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = sum_I l_I^2 ln(n_I . C n_I); for cells with axes."""
    assert isinstance(cells, OrthotropicCells)
    lengths, axes = cells.cell.dimensions, cells.cell.axes
    C = (axes * squared[:, None, :]) @ np.swapaxes(axes, 1, 2)  # in the cell's axes
    stretches = np.einsum("nii->ni", C)
    entries = lengths**2 / stretches
    value = np.swapaxes(axes, 1, 2) @ (entries[:, :, None] * axes)
    if not derivatives:
        return Terms(value, None, None)
    changes = np.zeros((len(lengths), 6, 6))
    steepness = -entries / stretches
    for i in range(3):
        changes[:, i, i] = 2 * lengths[:, i] / stretches[:, i]
    for column, (i, j) in enumerate(tensors.PAIRS, start=3):
        changes[:, column, column] = np.sqrt(2) * (entries[:, i] - entries[:, j])
        changes[:, i, column] = 2 * steepness[:, i] * C[:, i, j]
        changes[:, j, column] = -2 * steepness[:, j] * C[:, i, j]
    to_axes = cells.to_axes()
    along = to_axes * tensors.on_diagonal(steepness)[:, None, :]
    return Terms(value, to_axes @ changes, along @ np.swapaxes(to_axes, 1, 2))


class Stress(NamedTuple):
    """S (n, 3, 3) in the eigenbasis of C, r/L (n,), and derivatives of S by y and by C, (n, 6, 6)."""

    value: Array
    extension: Array
    by_cells: Array | None = None
    by_strain: Array | None = None
    turnover: Array | None = None


class Moduli(NamedTuple):
    """Of chains with length r: S = S_matrix + `chains` A - `repulsion` G, their slopes by r, and r/L; arrays (n,)."""

    chains: Array
    chains_slope: Array
    repulsion: Array
    repulsion_slope: Array
    extension: Array
    turnover: Array | None = None


def moduli(tissue: Tissue, r: Array, turned_over: TurnedOver | None) -> Moduli:
    """c g(r) and c g(r0); with turnover m c g(r/rho)/rho^2 and m c g(r0)."""
    chain, L, c = tissue.chain, tissue.contour_length, tissue.network_modulus
    assert chain is not None
    s = r if turned_over is None else r / turned_over.natural_length
    extension = s / L if chain.locks else np.zeros_like(r)
    tiny = 1e-30
    stiffness = chain.stiffness(s + 1j * tiny, L)  # plain arithmetic: its derivative by a complex step
    g, slope = stiffness.real, stiffness.imag / tiny
    g0 = c * chain.stiffness(tissue.end_to_end_length, L)
    if turned_over is None:
        return Moduli(c * g, c * slope, g0, np.zeros_like(r), extension)
    m, rho, by_m, by_rho = turned_over
    chains = m * c * g / rho**2
    relative = by_m + s * slope / g * (1.0 - by_rho) - 2.0 * by_rho
    logarithms = np.log(np.stack([m, rho], axis=1))
    return Moduli(chains, chains * relative / r, m * g0, m * g0 * by_m / r, extension, logarithms)


def stress(
    tissue: Tissue,
    strain: Strain,
    cells: LocalCells,
    derivatives: bool,
    turned_over: Callable[[Tissue, Array], TurnedOver] | None = None,
) -> Stress:
    """S of points whose parameters are arrays (n,)."""
    matrix, A = tissue.matrix.derivatives, cells.structure  # type: ignore[attr-defined]
    r = np.sqrt(np.einsum("nii,ni->n", A, strain.squared))
    chains = moduli(tissue, r, None if turned_over is None else turned_over(tissue, r))
    terms = resolved(tissue.repulsion.terms)  # type: ignore[arg-type]
    repulsion = Terms(*terms(strain.squared, cells, tissue.end_to_end_length, derivatives))
    of_matrix, by_strain = matrix(strain.squared, tissue.lame_lambda, tissue.lame_mu, derivatives)
    g, g0 = chains.chains[:, None, None], chains.repulsion[:, None, None]
    value = of_matrix + g * A - g0 * repulsion.value
    if not derivatives:
        return Stress(value, chains.extension, turnover=chains.turnover)
    assert repulsion.by_cells is not None and repulsion.by_strain is not None
    a, by_cells = tensors.to_mandel(A), cells.structure_by_cells()
    by_length = chains.chains_slope[:, None] * a
    if turned_over is not None:
        by_length = by_length - chains.repulsion_slope[:, None] * tensors.to_mandel(repulsion.value)
    steep = by_length / (2 * r)[:, None]  # by r^2 = A : C
    along = np.einsum("na,nab->nb", tensors.on_diagonal(strain.squared), by_cells)
    by_cells = tensors.dyads(steep, along) + g * by_cells - g0 * repulsion.by_cells
    by_strain = by_strain + tensors.dyads(steep, a) - g0 * repulsion.by_strain
    return Stress(value, chains.extension, by_cells, by_strain, chains.turnover)


# ---------------------------------------------------------------- cells that belong to the stress of the same step
# At each point: local Newton method and consistent tangent. At a point the cells at the end of a step are a function of
# F. The unknown is the driving tensor D in material space (U S U / J for `cauchy`, S for `pk2`, C for `finger`), six
# numbers:
#     D(C, S(C, y)) - D = 0,    y = y(F, D)                                        (i1)
# with six numbers y of the cells. With turnover, S has in it content and natural length at the end of the
# step, which are functions of r(C, y) (`laws.turned_over_at_the_end`). A change of F at a solution, with indices for
# derivatives, has
#     (1 - D_S S_y y_D) dD = D_C dC + D_S dS|_D,    dS|_D = S_C dC + S_y y_F dF    (i2)
#     dP = dF S + F dS,    dS = dS|_D + S_y y_D dD                                 (i3)
# which is not symmetric (docs/theory.md, "Implicit coupling"). Plain arrays of n points in, arrays out.

Flags = NDArray[np.bool_]

LOCAL_ITERATIONS = 25  # of the local Newton method
PARTS = 8  # of a step where the method does not find its end at once, each twice as long as what is before it
LOCAL_HALVINGS = 12  # of one of its steps, where it would lead to r >= L
TOLERANCE = 1e-12  # of D: where the local Newton method stops
IDENTITY = np.eye(6)


def refused(law: Law, driver: Driver, frame: Frame, matrix: Any, repulsion: Repulsion) -> str | None:
    """What a condensed step would need, where a part of the model has no derivatives for it; None where all have."""

    def those_with(what: str, registry: Mapping[str, Any]) -> str:
        return ", ".join(repr(name) for name, part in registry.items() if getattr(part, what))

    if law.response is None:
        return f"a remodeling.law towards a target: {those_with('response', LAWS)}"
    if driver.derivatives is None:
        return f"a remodeling.driver with derivatives: {those_with('derivatives', DRIVERS)}"
    if not frame.has_derivatives:
        return f"a remodeling.frame with derivatives: {those_with('has_derivatives', FRAMES)}"
    if not isinstance(matrix, Matrix) or matrix.derivatives is None:
        return "a material.matrix that is a Matrix with derivatives"
    if repulsion.terms is None:
        return f"a material.repulsion with derivatives: {those_with('terms', REPULSIONS)}"
    if repulsion.sees_axes and law.dimensions is None:
        blind = {name: part for name, part in REPULSIONS.items() if not part.sees_axes}
        return f"a material.repulsion that does not depend on axes, like its law: {those_with('terms', blind)}"
    return None


# ---------------------------------------------------------------- the local problem


class LocalSolution(NamedTuple):
    """Points whose cells belong to their stress, in the global basis."""

    gradient: Array
    driving_tensor: Array
    structure: Array
    first_piola_kirchhoff: Array
    squared_lengths: Array
    converged: Flags
    cells: UnitCell | None = None
    turnover: Array | None = None


class Trial(NamedTuple):
    """A driving tensor D (n, 3, 3) in the eigenbasis of C, with the cells and the stress that it makes."""

    tensor: Array
    cells: LocalCells
    stress: Stress
    missing: Array
    converged: Flags


class Linearised(NamedTuple):
    """S with its derivatives at a driving tensor, D_S and D_C, `answer` S_y y_D, and S_y y_U where there is one."""

    stress: Stress
    by_stress: Array
    by_strain: Array
    answer: Array
    answer_to_stretch: Array | None

    @property
    def left(self) -> Array:
        """1 - D_S S_y y_D of eq. (i2)."""
        return IDENTITY - self.by_stress @ self.answer


@dataclass(frozen=True)
class CondensedPoints:
    """Tissue and step of n points."""

    tissue: Tissue
    step: StepOfCells

    def at(self, chosen: Any) -> CondensedPoints:
        """Some of the points."""
        return CondensedPoints(self.tissue.map(lambda name, value: value[chosen]), at(self.step, chosen))

    # ------------------------------------------------------------ solutions
    def solve(self, F: Array, start: Array) -> LocalSolution:
        """Cells that belong to the stress at F."""
        strain = Strain.of(F)
        if not self.step.drive.driver.is_stress:  # D does not depend on the stress
            trial = self._trial(strain, self._driving(strain, np.zeros_like(F)))
            trial.converged[:] = np.isfinite(trial.stress.value).all(axis=(1, 2))
            return self._solution(strain, trial)
        trial = self._trial(strain, strain.inside(start))
        self._iterate(strain, trial)
        lost = np.flatnonzero(~trial.converged)
        if lost.size and self.step.law.dimensions is None:  # by rank there are states without a solution
            put(trial, lost, self.at(lost)._followed(at(strain, lost)))
        return self._solution(strain, trial)

    def with_cells(self, F: Array, cells: UnitCell) -> LocalSolution:
        """The points with cells that do not answer, given in the global basis."""
        strain = Strain.of(F)
        inside = self._cells(strain, structure_tensor(*cells[:2]), cells)
        stress = self._stress(strain, inside)
        tensor = self._driving(strain, stress.value)
        trial = Trial(tensor, inside, stress, np.zeros_like(F), np.ones(len(F), dtype=bool))
        return self._solution(strain, trial)

    def passed(self, found: LocalSolution) -> LocalSolution:
        """The points with the cells that a pass with their driving tensor makes."""
        strain = Strain.of(found.gradient)
        return self._solution(strain, self._trial(strain, strain.inside(found.driving_tensor)))

    def unit_cells(self, found: LocalSolution) -> UnitCell:
        """Lengths and axes, in the order of the cells at the start of the step."""
        if found.cells is not None:
            return found.cells
        squared, axes = spectral.continued(found.structure, self.step.cells.axes)
        return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)

    def _solution(self, strain: Strain, trial: Trial) -> LocalSolution:
        """In the global basis."""
        cells, A = None, trial.cells.structure
        if isinstance(trial.cells, OrthotropicCells):
            local = trial.cells.cell
            cells = UnitCell(local.dimensions, local.axes @ np.swapaxes(strain.basis, 1, 2))
        squared, turnover = np.einsum("nii,ni->n", A, strain.squared), trial.stress.turnover
        if turnover is not None:
            squared = squared * (self.tissue.natural_length / np.exp(turnover[:, 1])) ** 2
        return LocalSolution(
            strain.gradient,
            strain.outside(trial.tensor),
            strain.outside(A),
            strain.gradient @ strain.outside(trial.stress.value),
            squared,
            trial.converged,
            cells,
            turnover,
        )

    def _cells(self, strain: Strain, structure: Array, cells: UnitCell | None) -> LocalCells:
        """Cells in the eigenbasis of C, from A or from lengths and axes, as the law has them."""
        if self.step.law.dimensions is None:
            return StructureCells(strain.inside(structure))
        assert cells is not None
        return OrthotropicCells(UnitCell(cells.dimensions, cells.axes @ strain.basis))

    # ------------------------------------------------------------ the functions of eq. (i1)
    def _stress(self, strain: Strain, cells: LocalCells, derivatives: bool = False) -> Stress:
        """S with these cells."""
        return stress(self.tissue, strain, cells, derivatives, self.step.turned_over)

    def _driving(self, strain: Strain, stress: Array) -> Array:
        """D of S."""
        return self._driver(strain.squared, stress, False)[0]

    def _respond(self, strain: Strain, tensor: Array, derivatives: bool) -> Response:
        """Of the cells to D."""
        law: Callable[..., Response] = resolved(self.step.law.response)  # type: ignore[arg-type]
        return law(self.step, strain, self._place(strain, tensor), derivatives)

    @property
    def _driver(self) -> Callable[[Array, Array, bool], Derivatives]:
        assert self.step.drive.driver.derivatives is not None
        return self.step.drive.driver.derivatives

    def _place(self, strain: Strain, tensor: Array) -> Array:
        """X of D in the eigenbasis of C."""
        if not self.step.is_spatial:
            return tensor
        R = strain.rotation
        return R @ tensor @ np.swapaxes(R, 1, 2)

    def _trial(self, strain: Strain, tensor: Array) -> Trial:
        cells = self._respond(strain, tensor, derivatives=False).cells
        stress = self._stress(strain, cells)
        missing = self._driving(strain, stress.value) - tensor
        accuracy = TOLERANCE * np.linalg.norm(tensor, axis=(1, 2)) + self.step.drive.rounding
        converged = (np.linalg.norm(missing, axis=(1, 2)) <= accuracy) & (stress.extension < 1.0)
        return Trial(tensor, cells, stress, missing, converged)

    def _linearised(self, strain: Strain, tensor: Array) -> Linearised:
        cells, by_tensor, by_stretch = self._respond(strain, tensor, derivatives=True)
        stress = self._stress(strain, cells, derivatives=True)
        assert by_tensor is not None and stress.by_cells is not None
        answer = stress.by_cells @ by_tensor
        if self.step.is_spatial:
            answer = answer @ tensors.congruence(strain.rotation)
        _, by_stress, by_strain = self._driver(strain.squared, stress.value, True)
        return Linearised(
            stress, by_stress, by_strain, answer, None if by_stretch is None else stress.by_cells @ by_stretch
        )

    # ------------------------------------------------------------ Newton's method
    def _iterate(self, strain: Strain, trial: Trial) -> None:
        """Newton's method where there is no solution yet."""
        for _ in range(LOCAL_ITERATIONS):
            unsolved = np.flatnonzero(~trial.converged)
            if not unsolved.size:
                return
            put(trial, unsolved, self.at(unsolved)._better(at(strain, unsolved), at(trial, unsolved)))

    def _better(self, strain: Strain, trial: Trial) -> Trial:
        """One step of Newton's method on eq. (i1), not longer than D, halved where it leads to r >= L."""
        left, missing = self._linearised(strain, trial.tensor).left, tensors.to_mandel(trial.missing)
        components: Any = np.linalg.solve(left, missing[:, :, None])[:, :, 0]
        change = tensors.from_mandel(components)
        change = np.where(np.isfinite(change).all(axis=(1, 2), keepdims=True), change, 0.0)
        size, length = (np.linalg.norm(tensor, axis=(1, 2)) for tensor in (trial.tensor, change))
        size = np.maximum(size, np.linalg.norm(missing, axis=1))
        share = np.minimum(1.0, size / np.where(length > 0, length, 1.0))[:, None, None]
        best = self._trial(strain, trial.tensor + share * change)
        for _ in range(LOCAL_HALVINGS):
            lost = np.flatnonzero(~(best.stress.extension < 1.0))
            if not lost.size:
                break
            share[lost] /= 2
            shorter = trial.tensor[lost] + share[lost] * change[lost]
            put(best, lost, self.at(lost)._trial(at(strain, lost), shorter))
        return best

    def _followed(self, strain: Strain) -> Trial:
        """The solution that the cells at the start come to when the time of the step passes in parts."""
        found = self.with_cells(strain.gradient, self.step.cells)
        tensor = strain.inside(found.driving_tensor)
        duration = self.step.time_new - self.step.time_old
        for part in range(1, PARTS + 1):
            time = self.step.time_old + duration * 2.0 ** (part - PARTS)
            some = replace(self, step=self.step._replace(time_new=time))
            trial = some._trial(strain, tensor)
            some._iterate(strain, trial)
            tensor = trial.tensor
        return trial

    # ------------------------------------------------------------ the tangent
    def tangent(self, found: LocalSolution) -> Array:
        """dP/dF, (n, 3, 3, 3, 3); of points that have not converged at their cells."""
        strain, lost = Strain.of(found.gradient), ~found.converged
        tensor, C_F = strain.inside(found.driving_tensor), strain.by_gradient
        linear = self._linearised(strain, tensor)
        left, stress = linear.left, linear.stress
        assert stress.by_strain is not None
        left[lost] = IDENTITY
        at_fixed_tensor = stress.by_strain @ C_F + self._answer_to_deformation(strain, linear, tensor)
        right = linear.by_strain @ C_F + linear.by_stress @ at_fixed_tensor
        by_gradient = at_fixed_tensor + linear.answer @ np.linalg.solve(left, right)
        result = _first_by_gradient(strain, stress.value, by_gradient)
        if lost.any():
            result[lost] = self.at(lost).frozen_tangent(at(found, lost))
        return result

    def frozen_tangent(self, found: LocalSolution) -> Array:
        """dP/dF of cells that do not answer."""
        strain = Strain.of(found.gradient)
        stress = self._stress(strain, self._cells(strain, found.structure, found.cells), derivatives=True)
        assert stress.by_strain is not None
        return _first_by_gradient(strain, stress.value, stress.by_strain @ strain.by_gradient)

    def _answer_to_deformation(self, strain: Strain, linear: Linearised, tensor: Array) -> Any:
        """S_y y_F, (n, 6, 9): by the rotation where X lives in space, by the stretch where axes are pulled back."""
        if self.step.is_spatial:  # X = R D R^T changes by dR = R W as if D changed by W D - D W
            turned = tensors.TURNS @ tensor[:, None]
            by_turns = np.swapaxes(tensors.to_mandel(turned + np.swapaxes(turned, 2, 3)), 1, 2)
            return linear.answer @ by_turns @ strain.turn_by_gradient
        if linear.answer_to_stretch is None:
            return 0.0
        return linear.answer_to_stretch @ strain.stretch_by_strain @ strain.by_gradient


def _first_by_gradient(strain: Strain, stress: Array, by_gradient: Array) -> Array:
    """Eq. (i3): dP/dF from S and dS/dF (n, 6, 9). F dS is half of dC/dF, transposed, times dS."""
    result = (np.swapaxes(strain.by_gradient, 1, 2) @ by_gradient / 2).reshape(-1, 3, 3, 3, 3)
    for i in range(3):
        result[:, i, :, i, :] += strain.outside(stress)
    return result
