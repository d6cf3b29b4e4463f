"""Cells that belong to the stress of the same step: the local problem at each point, and its consistent tangent.

At a point the cells at the end of a step are a function of F. The unknown is the driving tensor D in material space,
six numbers: U S U / J for the driver `cauchy`, S for `pk2`, C for `finger`. It makes the cells, which have six numbers
y of their own; these make the stress, and that is what D must be of:

    D(C, S(C, y)) - D = 0,    y = y(F, D)                                        (i1)

Newton's method solves it (`LocalProblem.solve`). A change of F at a solution, with indices for derivatives, has

    (1 - D_S S_y y_D) dD = D_C dC + D_S dS|_D,    dS|_D = S_C dC + S_y y_F dF    (i2)
    dP = dF S + F dS,    dS = dS|_D + S_y y_D dD                                 (i3)

which is not symmetric (`LocalProblem.tangent`; docs/theory.md, "Implicit coupling"). Where the parts come from:

    F -> C, U, R               `Strain`, with the eigenbasis of C, in which all that follows is written
    y -> A, A_y                `LocalCells`
    C, y -> S, S_C, S_y        `stress`: matrix, chains, and one of the repulsions; with turnover, whose content and
                               natural length at the end of a step are functions of r(C, y)
    C, S -> D, D_S, D_C        `Driver.derivatives`
    F, D -> y, y_D, y_F        `Law.response`: `tensor_response`, `ranked_response`

Plain arrays of n points. Tensors are (n, 3, 3), their derivatives 6 x 6 matrices in Mandel components (`tensors`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import resolved
from remodel_fenicsx.model import spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, Driver, FRAMES, Frame, carried_axes
from remodel_fenicsx.model.energy import Matrix, REPULSIONS, Repulsion, Tissue
from remodel_fenicsx.model.laws import COMPLEX_STEP, Drive, LAWS, Law, Ranked, TurnedOver, TurnoverRule
from remodel_fenicsx.model.laws import by_rank, turned_over_at_the_end

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

AGREE = 1e-7
"""Relative difference of two principal values below which nothing is known about a turn in their plane."""
TOLERANCE = 1e-12  # of D, where Newton's method stops: what is left is below any residual that a body is solved to
# Of random cells: near a solution it takes 2 to 4, over a step of kappa dt = 1 up to 6, of 10 seldom above 17
LOCAL_ITERATIONS = 25
LOCAL_HALVINGS = 12  # of one of its steps, where it would lead to r >= L: 1/4096 of D is no step any more
# Of a step where it does not find the end at once, each twice as long as what is before it. The first is 1/128: of
# kappa dt = 10 less than 0.1, over which all random cells were found
PARTS = 8
IDENTITY = np.eye(6)
NOT_TURNED_OVER = TurnedOver(1.0, 1.0, 0.0, 0.0)


# ---------------------------------------------------------------- strain


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


# ---------------------------------------------------------------- cells


class LocalCells(NamedTuple):
    """Cells of n points in the eigenbasis of C: A (n, 3, 3), and of laws by rank the lengths and axes that make it.

    The numbers y are A itself; or the three dl, and three turns w_ij (`tensors.PAIRS`), dn_i = w n_j, dn_j = -w n_i.
    """

    structure: Array
    cell: UnitCell | None = None

    @classmethod
    def of(cls, cell: UnitCell) -> LocalCells:
        """From lengths and axes."""
        return cls(structure_tensor(cell.dimensions, cell.axes), cell)

    def structure_by_cells(self) -> Array:
        """dA/dy, (n, 6, 6): the identity; or dA = 2 l dl n n, and (l_i^2 - l_j^2) across the axes."""
        if self.cell is None:
            return np.broadcast_to(IDENTITY, (len(self.structure), 6, 6))
        lengths = self.cell.dimensions
        entries = np.zeros((len(lengths), 6))
        entries[:, :3] = 2 * lengths
        for row, (i, j) in enumerate(tensors.PAIRS, start=3):
            entries[:, row] = np.sqrt(2) * (lengths[:, i] ** 2 - lengths[:, j] ** 2)
        return to_axes(self.cell) * entries[:, None, :]


def to_axes(cell: UnitCell) -> Array:
    """Matrix (n, 6, 6) that takes components in the cell's axes to the basis in which the axes are given."""
    return tensors.congruence(np.swapaxes(cell.axes, 1, 2))


# ---------------------------------------------------------------- stress
# S = S_matrix + m c (g(r/rho)/rho^2 A - g(r0) G),  r^2 = A : C,  G = dM/dC


class Terms(NamedTuple):
    """G = dM/dC (n, 3, 3), and its derivatives by cells and by C, (n, 6, 6); None where they were not asked for."""

    value: Array
    by_cells: Any
    by_strain: Any


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
    assert cells.cell is not None
    lengths, axes, _ = cells.cell
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
    outwards = to_axes(cells.cell)
    along = outwards * tensors.on_diagonal(steepness)[:, None, :]
    return Terms(value, outwards @ changes, along @ np.swapaxes(outwards, 1, 2))


class Stress(NamedTuple):
    """S (n, 3, 3), r/L (n,), what turnover makes in the step, and derivatives of S by y and by C, (n, 6, 6)."""

    value: Array
    extension: Array
    turned_over: TurnedOver
    by_cells: Any = None
    by_strain: Any = None


def stress(tissue: Tissue, strain: Strain, cells: LocalCells, derivatives: bool, step: StepOfCells) -> Stress:
    """S of points whose parameters are arrays (n,)."""
    chain, L, A = tissue.chain, tissue.contour_length, cells.structure
    matrix: Any = tissue.matrix
    assert chain is not None
    r = np.sqrt(np.einsum("nii,ni->n", A, strain.squared))
    turned_over = step.turned_over(tissue, r)
    m, rho, by_m, by_rho = turned_over
    s, modulus = r / rho, m * tissue.network_modulus
    stiffness = chain.stiffness(s + 1j * COMPLEX_STEP, L)  # plain arithmetic: its derivative by a complex step
    g, g0 = stiffness.real, modulus * chain.stiffness(tissue.end_to_end_length, L)
    chains, against = (modulus * g / rho**2)[:, None, None], g0[:, None, None]
    terms = resolved(tissue.repulsion.terms)  # type: ignore[arg-type]
    G, G_by_cells, G_by_strain = terms(strain.squared, cells, tissue.end_to_end_length, derivatives)
    of_matrix, by_strain = matrix.derivatives(strain.squared, tissue.lame_lambda, tissue.lame_mu, derivatives)
    found = Stress(of_matrix + chains * A - against * G, s / L if chain.locks else np.zeros_like(r), turned_over)
    if not derivatives:
        return found
    # by ln r, on which both moduli depend; ln r by C, which is A/(2 r^2), and by cells
    steepness = s * stiffness.imag / COMPLEX_STEP * (1.0 - by_rho) + g * (by_m - 2.0 * by_rho)
    a, A_by_cells = tensors.to_mandel(A), cells.structure_by_cells()
    by_length = (modulus * steepness / rho**2)[:, None] * a - (g0 * by_m)[:, None] * tensors.to_mandel(G)
    steep = by_length / (2 * r**2)[:, None]
    along = np.einsum("na,nab->nb", tensors.on_diagonal(strain.squared), A_by_cells)
    return found._replace(
        by_cells=tensors.dyads(steep, along) + chains * A_by_cells - against * G_by_cells,
        by_strain=by_strain + tensors.dyads(steep, a) - against * G_by_strain,
    )


# ---------------------------------------------------------------- responses: what cells a driving tensor makes
# The tensor X lives where the law looks for its eigenvectors: in material space, or, for a spatial driver and the frame
# `spatial`, in space. The cells themselves are those of `laws`.


class StepOfCells(NamedTuple):
    """What points know of their cells in a step, in the global basis."""

    law: Law
    drive: Drive
    cells: UnitCell
    time_old: float
    time_new: float
    turnover: TurnoverRule | None = None

    @property
    def structure(self) -> Array:
        """A of the cells."""
        return structure_tensor(*self.cells[:2])

    def turned_over(self, tissue: Tissue, length: Array) -> TurnedOver:
        """Content and natural length at its end, where r there is `length`."""
        if self.turnover is None:
            return NOT_TURNED_OVER
        return turned_over_at_the_end(self.turnover, tissue, length, self.time_new - self.time_old)

    @property
    def is_spatial(self) -> bool:
        """Whether X lives in space."""
        return not self.drive.driver.material and not self.drive.frame.carries_axes

    @property
    def carries_axes(self) -> bool:
        """Whether the principal axes of X are pulled back to those of the cells."""
        return not self.drive.driver.material and self.drive.frame.carries_axes

    @property
    def kappa_dt(self) -> Array | float:
        """Its duration in the time of the cells, (n,) or a number."""
        return self.drive.kappa * (self.time_new - self.time_old)


class Response(NamedTuple):
    """Cells in the eigenbasis of C, and the derivatives of their numbers y by X and by U, (n, 6, 6)."""

    cells: LocalCells
    by_tensor: Any = None
    by_stretch: Any = None


def tensor_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """A = A_old + w (r0^2 E - A_old), w = 1 - exp(-kappa s dt): `tensor_law` and its derivative."""
    r0, z = np.asarray(step.drive.end_to_end_length), step.kappa_dt
    towards, old = tensor_law.target(tensor, step.drive.floor), strain.inside(step.structure)
    cells = LocalCells(tensor_law.follow(old, towards, r0, z))
    if not derivatives:
        return Response(cells)
    direction_by_tensor, switch_by_tensor = tensor_law.target_derivatives(tensor, step.drive.floor)
    squared, weight = r0**2, -np.expm1(-z * towards.switch)
    by_tensor = (squared * weight)[:, None, None] * direction_by_tensor
    way = tensors.to_mandel(squared[:, None, None] * towards.direction - old)
    by_tensor += tensors.dyads((z * np.exp(-z * towards.switch))[:, None] * way, switch_by_tensor)
    return Response(cells, by_tensor)


def ranked_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """Lengths by rank along the framed principal axes of X (`laws.by_rank`), and their derivatives."""
    assert step.law.dimensions is not None
    old = UnitCell(step.cells.dimensions, step.cells.axes @ strain.basis)
    found = by_rank(step.law.dimensions, old, _drive(step, strain, tensor, old), step.time_old, step.time_new)
    cells = LocalCells.of(found.cells)
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
    return step.drive._replace(deformation_gradient=U, tensor=steady)


def _lengths_by_values(step: StepOfCells, found: Ranked) -> Array:
    """dl/d(principal values of X), (n, 3, 3): de = (1 - e e) dv+ / |v+|, and the law's slope by a complex step."""
    drive, law, r0 = step.drive, step.law.dimensions, np.reshape(step.drive.end_to_end_length, (-1, 1))
    assert law is not None
    target: Any = found.target + 1j * COMPLEX_STEP
    lengths = law(step.cells.dimensions, drive.initial_dimensions, target, drive.kappas, step.time_old, step.time_new)
    e = found.target / r0
    size = np.linalg.norm(np.where(e > 0, found.values, 0.0), axis=1)
    steepness = np.imag(lengths) / COMPLEX_STEP * (r0 / np.where(found.active, size, 1.0)[:, None])
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


# ---------------------------------------------------------------- points
# Named tuples of arrays, one entry of each array a point: `at` takes some of them, `put` puts some into them.


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


class LocalSolution(NamedTuple):
    """Cells that belong to their stress, at the points that have converged; in the global basis."""

    gradient: Array
    driving_tensor: Array
    structure: Array
    first_piola_kirchhoff: Array
    squared_lengths: Array
    converged: Flags
    turnover: Array | None = None


class Slopes(NamedTuple):
    """dP/dF (n, 3, 3, 3, 3), and that of D (n, 6, 9), in Mandel components of the global basis."""

    tangent: Array
    by_gradient: Array


class Trial(NamedTuple):
    """A driving tensor D (n, 3, 3) in the eigenbasis of C, with the cells and the stress that it makes."""

    tensor: Array
    cells: LocalCells
    stress: Stress
    missing: Array
    converged: Flags


class Linearised(NamedTuple):
    """S with its derivatives at a D: D_S and D_C, S_y y_D, and S_y y_U where there is one."""

    stress: Stress
    by_stress: Array
    by_strain: Array
    through_cells: Array
    by_stretch: Array | None

    @property
    def left(self) -> Array:
        """1 - D_S S_y y_D of eq. (i2)."""
        return IDENTITY - self.by_stress @ self.through_cells


@dataclass(frozen=True)
class LocalProblem:
    """Eq. (i1) at n points: their tissue, and the step that their cells make."""

    tissue: Tissue
    step: StepOfCells

    def at(self, chosen: Any) -> LocalProblem:
        """Some of the points."""
        return LocalProblem(self.tissue.map(lambda name, value: value[chosen]), at(self.step, chosen))

    def solve(self, F: Array, guess: Array) -> LocalSolution:
        """Cells that belong to the stress at F, looked for from a D."""
        strain = Strain.of(F)
        if not self.step.drive.driver.is_stress:  # D does not depend on the stress
            trial = self._trial(strain, self._driving(strain, np.zeros_like(F)))
            trial.converged[:] = np.isfinite(trial.stress.value).all(axis=(1, 2))
            return self._solution(strain, trial)
        trial = self._trial(strain, strain.inside(guess))
        self._iterate(strain, trial)
        lost = np.flatnonzero(~trial.converged)
        if lost.size and self.step.law.dimensions is None:  # by rank there are states without a solution
            put(trial, lost, self.at(lost)._followed(at(strain, lost)))
        return self._solution(strain, trial)

    def tensor_of(self, F: Array, cells: UnitCell) -> Array:
        """D of cells that stay as they are."""
        strain = Strain.of(F)
        return strain.outside(self._tensor_of(strain, cells))

    def unit_cells(self, found: LocalSolution) -> UnitCell:
        """Lengths and axes, in the order of the cells at the start of the step."""
        if self.step.law.dimensions is not None:
            strain = Strain.of(found.gradient)
            inside = self._respond(strain, strain.inside(found.driving_tensor), derivatives=False).cells.cell
            assert inside is not None
            return UnitCell(inside.dimensions, inside.axes @ np.swapaxes(strain.basis, 1, 2))
        squared, axes = spectral.continued(found.structure, self.step.cells.axes)
        return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)

    def _solution(self, strain: Strain, trial: Trial) -> LocalSolution:
        """In the global basis."""
        parts = trial.tensor, trial.cells.structure, trial.stress.value
        D, A, S = (strain.outside(tensor) for tensor in parts)
        squared = np.einsum("nii,ni->n", trial.cells.structure, strain.squared)
        turnover = None
        if self.step.turnover is not None:
            content, length, *_ = trial.stress.turned_over
            turnover = np.log(np.stack([content, length], axis=1))
            squared = squared * (self.tissue.natural_length / length) ** 2
        F = strain.gradient
        return LocalSolution(F, D, A, F @ S, squared, trial.converged, turnover)

    # ------------------------------------------------------------ the functions of eq. (i1)
    def _driving(self, strain: Strain, stress: Array) -> Array:
        """D of S."""
        return self._derivatives(strain.squared, stress, False)[0]

    @property
    def _derivatives(self) -> Any:
        return self.step.drive.driver.derivatives

    def _tensor_of(self, strain: Strain, cells: UnitCell) -> Array:
        inside = LocalCells.of(UnitCell(cells.dimensions, cells.axes @ strain.basis))
        return self._driving(strain, stress(self.tissue, strain, inside, False, self.step).value)

    def _respond(self, strain: Strain, tensor: Array, derivatives: bool) -> Response:
        """Of the cells to D, from which X is turned into space where it lives there."""
        if self.step.is_spatial:
            tensor = strain.rotation @ tensor @ np.swapaxes(strain.rotation, 1, 2)
        law: Callable[..., Response] = resolved(self.step.law.response)  # type: ignore[arg-type]
        return law(self.step, strain, tensor, derivatives)

    def _trial(self, strain: Strain, tensor: Array) -> Trial:
        cells = self._respond(strain, tensor, derivatives=False).cells
        made = stress(self.tissue, strain, cells, False, self.step)
        missing = self._driving(strain, made.value) - tensor
        accuracy = TOLERANCE * np.linalg.norm(tensor, axis=(1, 2)) + self.step.drive.rounding
        converged = (np.linalg.norm(missing, axis=(1, 2)) <= accuracy) & (made.extension < 1.0)
        return Trial(tensor, cells, made, missing, converged)

    def _linearised(self, strain: Strain, tensor: Array) -> Linearised:
        cells, by_tensor, by_stretch = self._respond(strain, tensor, derivatives=True)
        made = stress(self.tissue, strain, cells, True, self.step)
        through_cells = made.by_cells @ by_tensor
        if self.step.is_spatial:
            through_cells = through_cells @ tensors.congruence(strain.rotation)
        _, by_stress, by_strain = self._derivatives(strain.squared, made.value, True)
        by_stretch = None if by_stretch is None else made.by_cells @ by_stretch
        return Linearised(made, by_stress, by_strain, through_cells, by_stretch)

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
        change = np.minimum(1.0, size / np.where(length > 0, length, 1.0))[:, None, None] * change
        best = self._trial(strain, trial.tensor + change)
        for _ in range(LOCAL_HALVINGS):
            lost = np.flatnonzero(~(best.stress.extension < 1.0))
            if not lost.size:
                break
            change[lost] /= 2
            put(best, lost, self.at(lost)._trial(at(strain, lost), trial.tensor[lost] + change[lost]))
        return best

    def _followed(self, strain: Strain) -> Trial:
        """The solution that the cells at the start come to when the time of the step passes in parts."""
        tensor, duration = self._tensor_of(strain, self.step.cells), self.step.time_new - self.step.time_old
        for part in range(1, PARTS + 1):
            time = self.step.time_old + duration * 2.0 ** (part - PARTS)
            some = replace(self, step=self.step._replace(time_new=time))
            trial = some._trial(strain, tensor)
            some._iterate(strain, trial)
            tensor = trial.tensor
        return trial

    # ------------------------------------------------------------ the tangent
    def tangent(self, found: LocalSolution) -> Slopes:
        """Of eqs. (i2) and (i3); the cells of points that have not converged stay."""
        strain = Strain.of(found.gradient)
        tensor, C_F = strain.inside(found.driving_tensor), strain.by_gradient
        linear = self._linearised(strain, tensor)
        linear.through_cells[~found.converged] = 0.0
        at_fixed_tensor = linear.stress.by_strain @ C_F
        if self.step.is_spatial:  # X = R D R^T changes by dR = R W as if D changed by W D - D W
            turned = tensors.TURNS @ tensor[:, None]
            by_turns = np.swapaxes(tensors.to_mandel(turned + np.swapaxes(turned, 2, 3)), 1, 2)
            at_fixed_tensor += linear.through_cells @ by_turns @ strain.turn_by_gradient
        if linear.by_stretch is not None:  # axes are pulled back
            linear.by_stretch[~found.converged] = 0.0
            at_fixed_tensor += linear.by_stretch @ strain.stretch_by_strain @ C_F
        right = linear.by_strain @ C_F + linear.by_stress @ at_fixed_tensor
        slope: Array = np.linalg.solve(linear.left, right)
        by_gradient = at_fixed_tensor + linear.through_cells @ slope
        # F dS is half of dC/dF, transposed, times dS
        result = (np.swapaxes(C_F, 1, 2) @ by_gradient / 2).reshape(-1, 3, 3, 3, 3)
        for i in range(3):
            result[:, i, :, i, :] += strain.outside(linear.stress.value)
        return Slopes(result, tensors.congruence(strain.basis) @ slope)


# ---------------------------------------------------------------- parts of the model without derivatives


def refused(law: Law, driver: Driver, frame: Frame, matrix: Any, repulsion: Repulsion) -> str | None:
    """What an implicit step would need, where a part of the model has no derivatives for it; None where all have."""

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
