"""Cells that belong to the stress of the same step, at each point: local Newton method and consistent tangent.

At a point the cells at the end of a step are a function of F. The unknown is the driving tensor D in material space
(U S U / J for `cauchy`, S for `pk2`, C for `finger`), six numbers:

    D(C, S(C, y)) - D = 0,    y = y(F, D)                                        (i1)

with six numbers y of the cells (`network`). With turnover, S has in it content and natural length at the end of the
step, which are functions of r(C, y) (`model.turnover.at_the_end`). A change of F at a solution, with indices for
derivatives, has

    (1 - D_S S_y y_D) dD = D_C dC + D_S dS|_D,    dS|_D = S_C dC + S_y y_F dF    (i2)
    dP = dF S + F dS,    dS = dS|_D + S_y y_D dD                                 (i3)

which is not symmetric (docs/theory.md, "Implicit coupling"). Plain arrays of n points in, arrays out.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import CAUCHY, DRIVERS, FINGER, FRAMES, MATERIAL, PK2, SPATIAL, Driver, Frame
from remodel_fenicsx.model.energy import BY_AXES, REPULSIONS, Matrix, Repulsion, Tissue
from remodel_fenicsx.model.implicit import network
from remodel_fenicsx.model.implicit.network import LocalCells, OrthotropicCells, Strain, Stress, StructureCells, at, put
from remodel_fenicsx.model.implicit.responses import StepOfCells, jumps_by_rank, response
from remodel_fenicsx.model.laws import LAWS, Law, tensor_target

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LOCAL_ITERATIONS = 25  # of the local Newton method
PARTS = 8  # of a step where the method does not find its end at once, each twice as long as what is before it
STALLED_ITERATIONS = (
    3  # of them in a row that do not leave PROGRESS times the residual: without a solution they go in a circle
)
PROGRESS = 0.9
LOCAL_HALVINGS = 12  # of one of its steps, where it would lead to r >= L
TOLERANCE = 1e-12  # of D: where the local Newton method stops
IDENTITY = np.eye(6)


# ---------------------------------------------------------------- drivers


class Driving(NamedTuple):
    """D in material space (n, 3, 3), and D_S and D_C as Mandel matrices (n or 1, 6, 6) where they are asked for."""

    tensor: Array
    by_stress: Any = None
    by_strain: Any = None


def _cauchy(strain: Strain, stress: Array, derivatives: bool) -> Driving:
    """U S U / J."""
    u = strain.stretches
    jacobian = u.prod(axis=1)[:, None, None]
    scales = u[:, :, None] * u[:, None, :] / jacobian
    D = scales * stress
    if not derivatives:
        return Driving(D)
    inverse: Any = 1 / strain.squared  # dD = 2 sym(dU S U) / J - D C^-1 : dC / 2
    across = np.swapaxes(stress * u[:, None, :], 1, 2) / jacobian
    by_stretch = 2 * tensors.congruence(np.broadcast_to(np.eye(3), D.shape), across)
    by_volume = tensors.dyads(tensors.to_mandel(D), tensors.on_diagonal(inverse / 2))
    return Driving(D, tensors.diagonal(scales), by_stretch @ strain.stretch_by_strain - by_volume)


def _second_piola_kirchhoff(strain: Strain, stress: Array, derivatives: bool) -> Driving:
    """S."""
    return Driving(stress, IDENTITY[None], np.zeros((1, 6, 6)))


def _right_cauchy_green(strain: Strain, stress: Array, derivatives: bool) -> Driving:
    """C: R^T b R."""
    C = np.zeros_like(stress)
    C[:, range(3), range(3)] = strain.squared
    return Driving(C, np.zeros((1, 6, 6)), IDENTITY[None])


DRIVING_TENSORS: dict[Driver, Callable[..., Driving]] = {
    CAUCHY: _cauchy,
    PK2: _second_piola_kirchhoff,
    FINGER: _right_cauchy_green,
}
"""D in material space of the drivers themselves: another of the same name has another."""


def _known(registry: Mapping[str, Any], table: Container[Any]) -> str:
    """Names of the parts that a table has."""
    return ", ".join(repr(name) for name, part in registry.items() if part in table)


def refused(law: Law, driver: Driver, frame: Frame, matrix: Any, repulsion: Repulsion) -> str | None:
    """What a condensed step would need, where a part of the model has no derivatives for it; None where all have."""
    laws = [other for other in LAWS.values() if other.dimensions or other.target is tensor_target]
    if law not in laws:
        return f"a remodeling.law towards a target: {_known(LAWS, laws)}"
    if driver not in DRIVING_TENSORS:
        return f"a remodeling.driver with derivatives: {_known(DRIVERS, DRIVING_TENSORS)}"
    if frame not in (MATERIAL, SPATIAL):
        return f"a remodeling.frame with derivatives: {_known(FRAMES, (MATERIAL, SPATIAL))}"
    if not isinstance(matrix, Matrix) or matrix.derivatives is None:
        return "a material.matrix that is a Matrix with derivatives"
    if repulsion not in network.TERMS:
        return f"a material.repulsion with derivatives: {_known(REPULSIONS, network.TERMS)}"
    if repulsion == BY_AXES and law.dimensions is None:
        return "a material.repulsion that does not depend on axes, like its law: 'log', 'length'"
    return None


# ---------------------------------------------------------------- the local problem


class LocalSolution(NamedTuple):
    """Points whose cells belong to their stress, in the global basis.

    Attributes
    ----------
    gradient
        F, (n, 3, 3).
    driving_tensor
        D, (n, 3, 3).
    structure
        A, (n, 3, 3).
    first_piola_kirchhoff
        P = F S, (n, 3, 3).
    squared_lengths
        r^2 = A : C, (n,); with turnover over (rho/rho_0)^2, rho_0 at the start: chains lock where it is rho_0^2 L^2.
    converged
        Whether the cells are those of D and D that of the stress, (n,); where not, cells belong to the last D.
    cells
        Lengths and axes of laws by rank.
    turnover
        ln m and ln rho at the end of the step, (n, 2), where they change.
    """

    gradient: Array
    driving_tensor: Array
    structure: Array
    first_piola_kirchhoff: Array
    squared_lengths: Array
    converged: Flags
    cells: UnitCell | None = None
    turnover: Array | None = None


class Trial(NamedTuple):
    """A driving tensor D (n, 3, 3) in the eigenbasis of C, with the cells and the stress that it makes.

    `missing`: the left side of eq. (i1), (n, 3, 3); `converged`: whether that is nothing, and r < L, (n,).
    """

    tensor: Array
    cells: LocalCells
    stress: Stress
    missing: Array
    converged: Flags


class Linearised(NamedTuple):
    """S and D with their derivatives at a driving tensor, `answer` S_y y_D, and S_y y_U where there is one."""

    stress: Stress
    driving: Driving
    answer: Array
    answer_to_stretch: Array | None

    @property
    def left(self) -> Array:
        """1 - D_S S_y y_D of eq. (i2)."""
        left: Array = IDENTITY - self.driving.by_stress @ self.answer
        return left


@dataclass(frozen=True)
class CondensedPoints:
    """Tissue and step of n points.

    Attributes
    ----------
    tissue
        Parameters as arrays (n,).
    step
        The cells at its start, and what they follow.
    """

    tissue: Tissue
    step: StepOfCells

    def at(self, chosen: Any) -> CondensedPoints:
        """Some of the points."""
        return CondensedPoints(self.tissue.map(lambda name, value: value[chosen]), at(self.step, chosen))

    # ------------------------------------------------------------ solutions
    def solve(
        self, F: Array, start: Array, held: Flags | None = None, before: LocalSolution | None = None
    ) -> LocalSolution:
        """Cells that belong to the stress at F.

        Parameters
        ----------
        F
            Deformation gradients with det F > 0, (n, 3, 3).
        start
            D from which to start, in the global basis, (n, 3, 3).
        held, before
            Points (n,) that have the cells of an earlier solution instead.
        """
        strain = Strain.of(F)
        held = np.zeros(len(F), dtype=bool) if held is None else held
        if self.step.drive.driver.is_stress:
            trial = self._trial(strain, strain.inside(start))
            trial.converged[held] = True
            self._iterate(strain, trial)
            lost = np.flatnonzero(~trial.converged)
            if lost.size and self.step.law.dimensions is None:  # by rank there are states without a solution
                put(trial, lost, self.at(lost)._followed(at(strain, lost)))
        else:  # D does not depend on the stress
            trial = self._trial(strain, self._driving(strain, np.zeros_like(F)).tensor)
            trial.converged[:] = np.isfinite(trial.stress.value).all(axis=(1, 2))
        found = self._solution(strain, trial)
        if held.any():
            assert before is not None and before.cells is not None
            put(found, held, self.at(held).with_cells(F[held], at(before.cells, held)))
        return found

    def with_cells(self, F: Array, cells: UnitCell) -> LocalSolution:
        """The points with cells that do not answer, given in the global basis."""
        strain = Strain.of(F)
        inside = self._cells(strain, structure_tensor(*cells[:2]), cells)
        stress = self._stress(strain, inside)
        tensor = self._driving(strain, stress.value).tensor
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
        terms = network.TERMS[self.tissue.repulsion]
        return network.stress(self.tissue, terms, strain, cells, derivatives, self.step.turned_over)

    def _driving(self, strain: Strain, stress: Array, derivatives: bool = False) -> Driving:
        """D of S."""
        return DRIVING_TENSORS[self.step.drive.driver](strain, stress, derivatives)

    def _place(self, strain: Strain, tensor: Array) -> Array:
        """X of D in the eigenbasis of C (`responses`)."""
        if not self.step.is_spatial:
            return tensor
        R = strain.rotation
        turned: Array = R @ tensor @ np.swapaxes(R, 1, 2)
        return turned

    def _trial(self, strain: Strain, tensor: Array) -> Trial:
        cells = response(self.step, strain, self._place(strain, tensor), derivatives=False).cells
        stress = self._stress(strain, cells)
        missing = self._driving(strain, stress.value).tensor - tensor
        accuracy = TOLERANCE * np.linalg.norm(tensor, axis=(1, 2)) + self.step.drive.rounding
        converged = (np.linalg.norm(missing, axis=(1, 2)) <= accuracy) & (stress.extension < 1.0)
        return Trial(tensor, cells, stress, missing, converged)

    def _linearised(self, strain: Strain, tensor: Array) -> Linearised:
        cells, by_tensor, by_stretch = response(self.step, strain, self._place(strain, tensor), derivatives=True)
        stress = self._stress(strain, cells, derivatives=True)
        assert by_tensor is not None and stress.by_cells is not None
        answer = stress.by_cells @ by_tensor
        if self.step.is_spatial:
            answer = answer @ tensors.congruence(strain.rotation)
        driving = self._driving(strain, stress.value, derivatives=True)
        return Linearised(stress, driving, answer, None if by_stretch is None else stress.by_cells @ by_stretch)

    # ------------------------------------------------------------ Newton's method
    def _iterate(self, strain: Strain, trial: Trial) -> None:
        """Newton's method where there is no solution yet; in vain it ends early only where there may be none."""
        jumps, stalled = jumps_by_rank(self.step), np.zeros(len(strain.squared), dtype=int)
        least = np.full(len(stalled), np.inf)
        for _ in range(LOCAL_ITERATIONS):
            unsolved = np.flatnonzero(~trial.converged & ~(jumps & (stalled >= STALLED_ITERATIONS)))
            if not unsolved.size:
                return
            better = self.at(unsolved)._better(at(strain, unsolved), at(trial, unsolved))
            put(trial, unsolved, better)
            missing = np.linalg.norm(better.missing, axis=(1, 2))
            stalled[unsolved] = np.where(missing < PROGRESS * least[unsolved], 0, stalled[unsolved] + 1)
            least[unsolved] = np.fmin(least[unsolved], missing)

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
    def tangent(self, found: LocalSolution, held: Flags) -> Array:
        """dP/dF, (n, 3, 3, 3, 3); of points that are held, and of those that have not converged, at their cells."""
        strain = Strain.of(found.gradient)
        tensor, C_F = strain.inside(found.driving_tensor), strain.by_gradient
        linear, frozen = self._linearised(strain, tensor), held | ~found.converged
        left, stress, driving = linear.left, linear.stress, linear.driving
        assert stress.by_strain is not None
        left[frozen] = IDENTITY
        at_fixed_tensor = stress.by_strain @ C_F + self._answer_to_deformation(strain, linear, tensor)
        right = driving.by_strain @ C_F + driving.by_stress @ at_fixed_tensor
        by_gradient = at_fixed_tensor + linear.answer @ np.linalg.solve(left, right)
        if frozen.any():  # their cells need not be those of D
            put((stress.value, by_gradient), frozen, self.at(frozen)._frozen(at(strain, frozen), at(found, frozen)))
        return _first_by_gradient(strain, stress.value, by_gradient)

    def _answer_to_deformation(self, strain: Strain, linear: Linearised, tensor: Array) -> Any:
        """S_y y_F, (n, 6, 9): by the rotation where X lives in space, by the stretch where axes are pulled back."""
        if self.step.is_spatial:  # X = R D R^T changes by dR = R W as if D changed by W D - D W
            turned = tensors.TURNS @ tensor[:, None]
            by_turns = np.swapaxes(tensors.to_mandel(turned + np.swapaxes(turned, 2, 3)), 1, 2)
            return linear.answer @ by_turns @ strain.turn_by_gradient
        if linear.answer_to_stretch is None:
            return 0.0
        return linear.answer_to_stretch @ strain.stretch_by_strain @ strain.by_gradient

    def _frozen(self, strain: Strain, found: LocalSolution) -> tuple[Array, Array]:
        """S and dS/dF of cells that do not answer."""
        stress = self._stress(strain, self._cells(strain, found.structure, found.cells), derivatives=True)
        assert stress.by_strain is not None
        return stress.value, stress.by_strain @ strain.by_gradient


def _first_by_gradient(strain: Strain, stress: Array, by_gradient: Array) -> Array:
    """Eq. (i3): dP/dF from S and dS/dF (n, 6, 9). F dS is half of dC/dF, transposed, times dS."""
    result = (np.swapaxes(strain.by_gradient, 1, 2) @ by_gradient / 2).reshape(-1, 3, 3, 3, 3)
    for i in range(3):
        result[:, i, :, i, :] += strain.outside(stress)
    return result
