"""Cells that belong to the stress of the same step, at each point: local Newton method and consistent tangent.

At a point the cells at the end of a step are a function of F. The unknown is the driving tensor D in material space
(U S U / J for `cauchy`, S for `pk2`, C for `finger`), six numbers:

    D(F, cells(F, D)) - D = 0.

The derivative of the stress then has the answer of the cells in it, and is not symmetric (docs/theory.md, "Implicit
coupling"). Plain arrays of n points in, arrays out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import mandel
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES, Driver, Frame
from remodel_fenicsx.model.energy import REPULSIONS, Matrix, Repulsion, Tissue
from remodel_fenicsx.model.implicit import network, tangents
from remodel_fenicsx.model.implicit.network import LocalCells, OrthotropicCells, Strain, Stress, StructureCells
from remodel_fenicsx.model.implicit.responses import Response, StepOfCells, jumps_by_rank, response
from remodel_fenicsx.model.laws import LAWS, Law

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


def _cauchy(strain: Strain, stress: Stress, derivatives: bool) -> tuple[Array, Array | None, Array | None]:
    """U S U / J, and its derivatives by S and by C."""
    u = strain.stretches
    jacobian = u.prod(axis=1)[:, None, None]
    scales = u[:, :, None] * u[:, None, :] / jacobian
    D = scales * stress.value
    if not derivatives:
        return D, None, None
    by_stress = mandel.diagonal(scales)
    by_stretch = mandel.symmetric_product(stress.value * u[:, None, :] / jacobian)
    by_strain: Array = by_stretch @ _stretch_by_strain(strain)
    inverse: Any = 0.5 / strain.squared
    return D, by_stress, by_strain - mandel.dyads(mandel.vectors(D), mandel.on_diagonal(inverse))


def _second_piola_kirchhoff(strain: Strain, stress: Stress, derivatives: bool) -> tuple[Array, Any, Any]:
    """S."""
    return stress.value, IDENTITY[None], np.zeros((1, 6, 6))


def _right_cauchy_green(strain: Strain, stress: Stress, derivatives: bool) -> tuple[Array, Any, Any]:
    """C: R^T b R."""
    C = np.zeros_like(stress.value)
    C[:, range(3), range(3)] = strain.squared
    return C, np.zeros((1, 6, 6)), IDENTITY[None]


def _stretch_by_strain(strain: Strain) -> Array:
    """dU/dC: 1/(u_i + u_j)."""
    u = strain.stretches
    return mandel.diagonal(1 / (u[:, :, None] + u[:, None, :]))


DRIVING_TENSORS: dict[str, Callable[..., tuple[Array, Any, Any]]] = {
    "cauchy": _cauchy,
    "pk2": _second_piola_kirchhoff,
    "finger": _right_cauchy_green,
}
"""D in material space of the drivers, by their names in `drivers.DRIVERS`."""


def refused(law: Law, driver: Driver, frame: Frame, matrix: Any, repulsion: Repulsion) -> str | None:
    """What a condensed step would need, where a part of the model has no derivatives for it; None where all have."""
    if law.dimensions is None and law.target is None:
        laws = ", ".join(repr(name) for name, other in LAWS.items() if other.dimensions or other.target)
        return f"a remodeling.law towards a target: {laws}"
    if all(driver is not DRIVERS.get(name) for name in DRIVING_TENSORS):
        return "a remodeling.driver with derivatives: " + ", ".join(map(repr, DRIVING_TENSORS))
    if all(frame is not FRAMES.get(name) for name in ("material", "spatial")):
        return "a remodeling.frame with derivatives: 'material', 'spatial'"
    if not isinstance(matrix, Matrix) or matrix.derivatives is None:
        return "a material.matrix that is a Matrix with derivatives"
    if all(repulsion is not REPULSIONS.get(name) for name in network.TERMS):
        return "a material.repulsion with derivatives: " + ", ".join(map(repr, network.TERMS))
    if repulsion is REPULSIONS["axes"] and law.dimensions is None:
        return "a material.repulsion that sees no axes, as its law: 'log', 'length'"
    return None


# ---------------------------------------------------------------- the local problem


@dataclass(frozen=True)
class LocalSolution:
    """Points whose cells belong to their stress.

    Attributes
    ----------
    strain
        Where.
    tensor
        D in the eigenbasis of C, (n, 3, 3).
    response, stress
        Cells and S there.
    converged
        Whether they do, (n,); where not, they belong to the last D.
    missing
        |D(F, cells) - D|, (n,).
    """

    strain: Strain
    tensor: Array
    response: Response
    stress: Stress
    converged: Flags
    missing: Array

    @property
    def first_piola_kirchhoff(self) -> Array:
        """P = F S, (n, 3, 3)."""
        found: Array = self.strain.gradient @ self.strain.outside(self.stress.value)
        return found

    @property
    def driving_tensor(self) -> Array:
        """D in the global basis."""
        return self.strain.outside(self.tensor)

    @property
    def squared_lengths(self) -> Array:
        """r^2 = A : C, (n,)."""
        found: Array = np.einsum("nii,ni->n", self.response.cells.structure, self.strain.squared)
        return found

    @property
    def structure(self) -> Array:
        """A in the global basis, (n, 3, 3)."""
        return self.strain.outside(self.response.cells.structure)

    @property
    def cells(self) -> UnitCell:
        """Lengths and axes in the global basis, as the law orders them; of laws by rank."""
        cells, place = self.response.cells, self.response.place
        assert isinstance(cells, OrthotropicCells) and place is not None
        back = np.argsort(place, axis=1)
        axes = cells.cell.axes @ np.swapaxes(self.strain.basis, 1, 2)
        return UnitCell(
            np.take_along_axis(cells.cell.dimensions, back, axis=1),
            np.take_along_axis(axes, back[:, :, None], axis=1),
        )


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
        return CondensedPoints(self.tissue.map(lambda name, value: value[chosen]), self.step.at(chosen))

    @property
    def _terms(self) -> Callable[..., network.Terms]:
        return next(terms for name, terms in network.TERMS.items() if REPULSIONS.get(name) is self.tissue.repulsion)

    @property
    def _tensor(self) -> Callable[..., tuple[Array, Any, Any]]:
        return next(tensor for name, tensor in DRIVING_TENSORS.items() if DRIVERS.get(name) is self.step.driver)

    def stress(self, strain: Strain, cells: LocalCells, derivatives: bool = False) -> Stress:
        """S with these cells."""
        return network.stress(self.tissue, self._terms, strain, cells, derivatives)

    def kept(self, F: Array, cells: UnitCell, structure: Array) -> LocalSolution:
        """The points with cells that do not answer, given in the global basis (A for the law for A)."""
        strain = Strain.of(F)
        inside: LocalCells = StructureCells(strain.inside(structure))
        place = None
        if self.step.law.dimensions is not None:
            inside = OrthotropicCells(UnitCell(cells.dimensions, cells.axes @ strain.basis))
            place = np.tile(np.arange(3), (len(F), 1))
        stress = self.stress(strain, inside)
        tensor = self._tensor(strain, stress, False)[0]
        return LocalSolution(
            strain, tensor.copy(), Response(inside, place=place), stress, np.ones(len(F), dtype=bool), np.zeros(len(F))
        )

    def passed(self, F: Array, found: LocalSolution) -> LocalSolution:
        """Points with the cells that a pass with their driving tensor makes."""
        strain = Strain.of(F)
        return self._at_tensor(strain, strain.inside(found.driving_tensor))

    # ------------------------------------------------------------ X of D
    def _place(self, strain: Strain, tensor: Array) -> Array:
        """X of D in the eigenbasis of C."""
        if not self.step.is_spatial:
            return tensor
        R = strain.rotation
        turned: Array = R @ tensor @ np.swapaxes(R, 1, 2)
        return turned

    # ------------------------------------------------------------ Newton's method
    def solve(self, F: Array, start: Array, left_out: Flags | None = None) -> LocalSolution:
        """Cells that belong to the stress at F.

        Parameters
        ----------
        F
            Deformation gradients with det F > 0, (n, 3, 3).
        start
            D from which to start, in the global basis, (n, 3, 3).
        left_out
            Points at which nothing is solved: their cells are those of `start`.
        """
        strain = Strain.of(F)
        found = self._at_tensor(strain, strain.inside(start))
        if self.step.driver is DRIVERS["finger"]:
            finite: Any = np.isfinite(found.stress.value).all(axis=(1, 2))
            return replace(found, converged=finite)
        if left_out is not None:
            found.converged[left_out] = True
        self._iterate(found)
        lost = np.flatnonzero(~found.converged)
        if lost.size and self.step.law.dimensions is None:  # by rank there are states without a solution
            put(found, lost, self.at(lost)._followed(F[lost], found.strain.at(lost)))
        return found

    def _iterate(self, found: LocalSolution) -> None:
        """Newton's method where there is no solution yet."""
        open_points: NDArray[Any] = np.flatnonzero(~found.converged)
        jumps = jumps_by_rank(self.step)[open_points]
        most: NDArray[Any] = np.where(jumps, STALLED_ITERATIONS, LOCAL_ITERATIONS)  # the others have a solution
        least: Array = np.full(open_points.size, np.inf)
        patience: NDArray[Any] = most
        for _ in range(LOCAL_ITERATIONS):
            if not open_points.size:
                break
            improved = self.at(open_points)._iterated(_taken(found, open_points))
            put(found, open_points, improved)
            patience = np.where(improved.missing < PROGRESS * least, most, patience - 1)
            least, goes_on = np.fmin(least, improved.missing), ~improved.converged & (patience > 0)
            open_points, least = open_points[goes_on], least[goes_on]
            patience, most = patience[goes_on], most[goes_on]

    def _followed(self, F: Array, strain: Strain) -> LocalSolution:
        """The solution that the cells at the start come to when the time of the step passes in parts."""
        tensor = self.kept(F, self.step.cells, self.step.structure).tensor
        duration = self.step.time_new - self.step.time_old
        for part in range(1, PARTS + 1):
            time = self.step.time_old + duration * 2.0 ** (part - PARTS)
            some = replace(self, step=replace(self.step, time_new=time))
            found = some._at_tensor(strain, tensor)
            some._iterate(found)
            tensor = found.tensor
        return found

    def _at_tensor(self, strain: Strain, tensor: Array) -> LocalSolution:
        if self.step.driver is DRIVERS["finger"]:
            tensor = np.zeros_like(tensor)
            tensor[:, range(3), range(3)] = strain.squared
        answer = response(self.step, strain, self._place(strain, tensor), derivatives=False)
        stress = self.stress(strain, answer.cells)
        missing = np.linalg.norm(self._tensor(strain, stress, False)[0] - tensor, axis=(1, 2))
        converged = missing <= TOLERANCE * np.linalg.norm(tensor, axis=(1, 2)) + self.step.rounding
        return LocalSolution(strain, tensor, answer, stress, converged & (stress.extension < 1.0), missing)

    def _iterated(self, found: LocalSolution) -> LocalSolution:
        """One step of Newton's method, not longer than D, halved where it leads to r >= L."""
        strain = found.strain
        answer, stress, by_stress, _ = self._derivatives(found)
        matrix, missing = self._equation(found, answer, stress, by_stress)
        steps: Any = np.linalg.solve(matrix, missing[:, :, None])[:, :, 0]
        change = mandel.tensors(steps)
        change = np.where(np.isfinite(change).all(axis=(1, 2), keepdims=True), change, 0.0)
        size, length = (np.linalg.norm(tensor, axis=(1, 2)) for tensor in (found.tensor, change))
        size = np.maximum(size, np.linalg.norm(missing, axis=1))
        share = np.minimum(1.0, size / np.where(length > 0, length, 1.0))
        best = self._at_tensor(strain, found.tensor + share[:, None, None] * change)
        for _ in range(LOCAL_HALVINGS):
            lost = np.flatnonzero(~(best.stress.extension < 1.0))
            if not lost.size:
                break
            share[lost] /= 2
            tensors = found.tensor[lost] + share[lost, None, None] * change[lost]
            put(best, lost, self.at(lost)._at_tensor(strain.at(lost), tensors))
        return best

    def _frozen(self, strain: Strain, cells: LocalCells) -> Array:
        """dS/dC of cells that do not answer."""
        by_strain = self.stress(strain, cells, derivatives=True).by_strain
        assert by_strain is not None
        return by_strain

    def _derivatives(self, found: LocalSolution) -> tuple[Response, Stress, Array, Array]:
        strain = found.strain
        answer = response(self.step, strain, self._place(strain, found.tensor), derivatives=True)
        stress = self.stress(strain, answer.cells, derivatives=True)
        _, by_stress, by_strain = self._tensor(strain, stress, True)
        return answer, stress, by_stress, by_strain

    def _equation(
        self, found: LocalSolution, answer: Response, stress: Stress, by_stress: Array
    ) -> tuple[Array, Array]:
        """1 - dD/dcells dcells/dD, and D(cells) - D as Mandel vectors."""
        by_tensor = answer.by_tensor
        assert by_tensor is not None and stress.by_cells is not None
        if self.step.is_spatial:
            by_tensor = by_tensor @ mandel.congruence(found.strain.rotation)
        matrix = IDENTITY - by_stress @ (stress.by_cells @ by_tensor)
        missing = self._tensor(found.strain, stress, False)[0] - found.tensor
        return matrix, mandel.vectors(missing)

    # ------------------------------------------------------------ the tangent
    def tangent(self, found: LocalSolution, held: Flags) -> Array:
        """dP/dF, (n, 3, 3, 3, 3); of points that are held, and of those that have not converged, at their cells."""
        strain, spatial = found.strain, self.step.is_spatial
        answer, stress, by_stress, by_strain = self._derivatives(found)
        by_tensor, by_cells = answer.by_tensor, stress.by_cells
        assert by_tensor is not None and by_cells is not None and stress.by_strain is not None
        matrix, _ = self._equation(found, answer, stress, by_stress)
        frozen = held | ~found.converged
        direct = stress.by_strain
        if frozen.any():  # their cells need not be those of D
            direct[frozen] = self.at(frozen)._frozen(strain.at(frozen), _some_cells(found.response.cells, frozen))
        own = np.zeros_like(direct)
        if answer.by_stretch is not None:
            own = answer.by_stretch @ _stretch_by_strain(strain)
        right = by_strain + by_stress @ (direct + by_cells @ own)
        turn = mandel.congruence(strain.rotation) if spatial else None
        matrix[frozen] = IDENTITY
        change = np.linalg.solve(matrix, np.broadcast_to(right, matrix.shape))
        answers = by_tensor @ change if turn is None else by_tensor @ turn @ change
        total = direct + np.where(frozen[:, None, None], 0.0, by_cells @ (answers + own))
        outside = mandel.congruence(strain.basis)
        total = outside @ total @ np.swapaxes(outside, 1, 2)
        result = tangents.of_deformation_gradient(strain, found.stress.value, total)
        if turn is not None:
            turned = tangents.turned(strain, found.tensor)
            moved = by_tensor @ turned
            moved = moved + by_tensor @ turn @ np.linalg.solve(matrix, by_stress @ by_cells @ moved)
            of_turns = np.where(frozen[:, None, None], 0.0, outside @ by_cells @ moved)
            result += tangents.of_rotation(strain, of_turns)
        return result


def _some_cells(cells: LocalCells, chosen: Any) -> LocalCells:
    """Of some of the points."""
    if isinstance(cells, OrthotropicCells):
        return OrthotropicCells(UnitCell(cells.cell.dimensions[chosen], cells.cell.axes[chosen]))
    return StructureCells(cells.structure[chosen])


# ---------------------------------------------------------------- some of the points


def _taken(found: LocalSolution, chosen: Any) -> LocalSolution:
    """A solution of some of the points: what a step of Newton's method needs."""
    return replace(
        found,
        strain=found.strain.at(chosen),
        tensor=found.tensor[chosen],
        converged=found.converged[chosen],
        missing=found.missing[chosen],
    )


def put(found: LocalSolution, chosen: Any, better: LocalSolution) -> None:
    """Put some of the points into a solution."""
    found.tensor[chosen] = better.tensor
    found.converged[chosen] = better.converged
    found.missing[chosen] = better.missing
    found.stress.value[chosen] = better.stress.value
    found.stress.extension[chosen] = better.stress.extension
    mine, others = found.response.cells, better.response.cells
    if isinstance(mine, OrthotropicCells) and isinstance(others, OrthotropicCells):
        mine.cell.dimensions[chosen] = others.cell.dimensions
        mine.cell.axes[chosen] = others.cell.axes
        assert found.response.place is not None and better.response.place is not None
        found.response.place[chosen] = better.response.place
    else:
        mine.structure[chosen] = others.structure
