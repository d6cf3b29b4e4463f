"""Couplings that carry along derivatives of each step by numbers of the scene, of bodies in which nothing turns.

With the unknowns u, the lengths of the cells l and numbers theta: K du = -(R_theta dtheta + R_l dl) in each solved
state, then dl of the pass. R_theta is the derivative of the forms by their Constants; it is exact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import ufl
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from ufl.algorithms.analysis import extract_constants

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Extrapolated, Maker, Staggered
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem import jit
from remodel_fenicsx.model import tensor_law
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Stresses, Tissue
from remodel_fenicsx.model.laws import Drive, Law, RankedFunction, tensor_target
from remodel_fenicsx.model.tensor_law import Target
from remodel_fenicsx.schema.settings import Remodeling, Solver
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.solver.equilibrium import Equilibrium, mandel_vector
from remodel_fenicsx.state.state import State

Array = NDArray[np.float64]

_COMPLEX_STEP = 1e-30  # its square vanishes beside 1: the derivative is exact to rounding
_JACOBIAN_STEP = 1e-5  # of a logarithm of an unknown: errors of 1e-10, from the cubic and from rounding


class Directions(NamedTuple):
    """How the numbers of a run change with k unknowns."""

    tissue: Mapping[str, Array]
    kappa: Array
    loads: Callable[[float], Mapping[str, Array]]


def refused(settings: Remodeling, law: Law, coupling: str) -> str | None:
    """Why a run has no derivatives here, in words; None where it has them."""
    if not law.remodels:
        return None
    if settings.turnover.is_on:
        return "remodeling.turnover has no derivative"
    if settings.has_set_point:
        return "remodeling.threshold and remodeling.exponent have no derivative"
    if law.target is not tensor_target and law.dimensions is None:
        return f"remodeling.law = {settings.law!r} has no derivative"
    if coupling not in COUPLINGS_WITH_DERIVATIVES:
        return f"remodeling.coupling = {coupling!r} has no derivative"
    return None


def axes_lie_along(axes: Array) -> bool:
    """Whether all axes of cells, rows (n, 3, 3), lie along the coordinates: else F, however diagonal, turns them."""
    return bool(np.allclose(np.sort(np.abs(axes), axis=2), [0.0, 0.0, 1.0], rtol=0, atol=1e-12))


# ---------------------------------------------------------------- a solved state
def along_constants(expression: Any, ways: Mapping[Any, Any]) -> Any:
    """Derivative of UFL, a form or an expression, by its Constants, each in the direction that belongs to it."""
    there = set(expression.constants() if isinstance(expression, ufl.Form) else extract_constants(expression))
    variables = {constant: ufl.variable(constant) for constant in ways if constant in there}
    if not variables:
        return None
    varied = ufl.replace(expression, variables)
    return _sum([ways[constant] * ufl.diff(varied, variable) for constant, variable in variables.items()])


def _sum(terms: list[Any]) -> Any:
    known = [term for term in terms if term is not None]
    return sum(known[1:], known[0]) if known else None


class LinearisedEquilibrium:
    """K du = -(R_theta dtheta + R_l dl) and the change of the driving tensor's principal values, compiled; serial."""

    def __init__(self, equilibrium: Equilibrium, remodeling: RemodelingPass, names: tuple[str, ...]):
        self.equilibrium, self.state, self.names = equilibrium, equilibrium.state, names
        state, quadrature, tissue = self.state, equilibrium.quadrature, equilibrium.tissue
        mesh, u, cells = quadrature.mesh, state.unknown, state.cells
        self._numbers = {name: dolfinx.fem.Constant(mesh, np.float64(0.0)) for name in names}
        self._loads = [
            (name, dolfinx.fem.Constant(mesh, np.float64(0.0)), constant, scale)
            for name in state.loading.values
            for constant, scale in state.loading.constants(name)
            if constant.ufl_shape == ()
        ]
        ways = {getattr(tissue, name): way for name, way in self._numbers.items()}
        ways |= {constant: way for _, way, constant, _ in self._loads}
        self._change_of_unknown = dolfinx.fem.Function(u.function_space)
        self._change_of_dimensions = quadrature.function("change_of_dimensions", (3,))
        self._change_of_stress = quadrature.function("change_of_repulsion_stress", (3, 3))
        self._change_of_jacobian = quadrature.function("change_of_jacobian", ())
        F, test = state.kinematics.elastic_gradient(u), ufl.TestFunction(u.function_space)
        residuals = [ufl.derivative(energy, u, test) for energy in equilibrium.energies]
        forms = [along_constants(residual, ways) for residual in residuals]
        if tissue.chain is not None:
            forms += [ufl.derivative(residual, cells.dimensions, self._change_of_dimensions) for residual in residuals]
        if equilibrium.pointwise is not None:
            forms.append(self._of_repulsion(F, along_constants(F, ways), ufl.derivative(F, u, test)))
        external = state.loading.external_residual(test)
        whole = [_sum(forms), None if external is None else along_constants(external, ways)]
        self._forms = [jit.form(form) for form in whole if form is not None]
        self._matrix = equilibrium.create_matrix()
        self._driver = None
        if remodeling.law.remodels:
            self._driver = jit.expression(self._change_of_driver(remodeling, F, ways), quadrature.points)

    def _of_repulsion(self, F: Any, change: Any, variation: Any) -> Any:
        """Change of the virtual work of a repulsion that UFL leaves out, at frozen unknowns."""
        pointwise, state, quadrature = self.equilibrium.pointwise, self.state, self.equilibrium.quadrature
        assert pointwise is not None
        force = ufl.dot(F, self._whole_change_of_stress(F, change))
        if change is not None:
            force += ufl.dot(change, pointwise.stress)
        return ufl.inner(force, variation) * state.kinematics.stress_free_weight(quadrature.mesh) * quadrature.dx

    def _whole_change_of_stress(self, F: Any, change: Any) -> Any:
        """Of the repulsion: what numbers and cells make, and what a change of F makes, UFL."""
        pointwise = self.equilibrium.pointwise
        assert pointwise is not None
        if change is None:
            return self._change_of_stress
        strain = ufl.sym(ufl.dot(ufl.transpose(F), change))
        s = ufl.dot(pointwise.stiffness, mandel_vector(strain))
        return self._change_of_stress + ufl.as_tensor([[s[0], 0.0, 0.0], [0.0, s[1], 0.0], [0.0, 0.0, s[2]]])

    def _change_of_driver(self, remodeling: RemodelingPass, F: Any, ways: Mapping[Any, Any]) -> Any:
        """Of the driving tensor's diagonal, UFL (3,)."""
        state, pointwise, tissue = self.state, self.equilibrium.pointwise, self.equilibrium.tissue
        u, way = state.unknown, self._change_of_unknown
        stresses = state.dilatation.stresses(tissue, F, [state.cells.ufl_cell])
        if pointwise is not None:
            stresses = stresses.plus(F, pointwise.stress)
        tensor = remodeling.driver.tensor(F, stresses)
        terms = [ufl.derivative(tensor, u, way), along_constants(tensor, ways)]
        if tissue.chain is not None:
            terms.append(ufl.derivative(tensor, state.cells.dimensions, self._change_of_dimensions))
        if (jacobian := state.dilatation.jacobian) is not None:
            terms.append(ufl.derivative(tensor, jacobian, self._change_of_jacobian))
        if pointwise is not None and remodeling.driver.is_stress:  # linear in the stress
            change = self._whole_change_of_stress(F, _sum([ufl.derivative(F, u, way), along_constants(F, ways)]))
            nothing = ufl.zero(3, 3)
            terms.append(remodeling.driver.tensor(F, Stresses(nothing, nothing, nothing).plus(F, change)))
        total = _sum(terms)
        return ufl.as_vector([total[i, i] for i in range(3)])

    def solve(self, directions: Directions, time: float, dimensions: Array) -> tuple[Array, Array]:
        """Of the present state: du (k, unknowns), and the change of the driver's principal values (k, n, 3)."""
        matrix, held = self._matrix, ~np.isnan(self.equilibrium.prescribed_values())
        self.equilibrium.assemble_tangent(matrix)
        tangent = csr_matrix(matrix.getValuesCSR()[::-1], shape=matrix.getSize()).toarray()
        stresses, loads = self._changes_of_stress(directions, dimensions), directions.loads(time)
        sides = np.zeros((len(dimensions), len(held)))
        for k, side in enumerate(sides):
            self._set(directions, loads, k, dimensions, stresses)
            for form in self._forms:
                dolfinx.fem.assemble_vector(side, form)
        sides[:, held] = 0.0
        unknowns = -np.linalg.solve(tangent, sides.T).T
        return unknowns, self._changes_of_driver(directions, loads, dimensions, stresses, unknowns)

    def _changes_of_driver(
        self, directions: Directions, loads: Mapping[str, Array], dimensions: Array, stresses: Any, unknowns: Array
    ) -> Array:
        quadrature = self.equilibrium.quadrature
        found = np.zeros((len(dimensions), *quadrature.shape, 3))
        if self._driver is not None:
            for k, change in enumerate(unknowns):
                self._set(directions, loads, k, dimensions, stresses)
                self._change_of_unknown.x.array[:] = change
                self._set_jacobian(change)
                found[k] = quadrature.evaluate(self._driver, (3,))
        return found.reshape(len(dimensions), -1, 3)

    def _set(
        self, directions: Directions, loads: Mapping[str, Array], k: int, dimensions: Array, stresses: Any
    ) -> None:
        """All directions are those of the unknown number k."""
        for name, way in self._numbers.items():
            way.value = directions.tissue[name][k]
        for name, way, _, scale in self._loads:
            way.value = scale * loads[name][k] if name in loads else 0.0
        self._change_of_dimensions.x.array[:] = dimensions[k].reshape(-1)
        if stresses is not None:
            self._change_of_stress.x.array[:] = stresses[k].reshape(-1)

    def _set_jacobian(self, change: Any) -> None:
        """The change of a formulation's own J, by a central difference: it is a cubic of the unknowns at most."""
        dilatation, values = self.state.dilatation, self.state.unknown.x.array
        if dilatation.jacobian is None:
            return
        present, ends = values.copy(), []
        for way in (_JACOBIAN_STEP, -_JACOBIAN_STEP, 0.0):
            values[:] = present + way * change
            dilatation.refresh()
            ends.append(dilatation.jacobian.x.array.copy())
        self._change_of_jacobian.x.array[:] = (ends[0] - ends[1]) / (2 * _JACOBIAN_STEP)

    def _changes_of_stress(self, directions: Directions, dimensions: Array) -> Array | None:
        """Of a repulsion that is linear in A, at frozen F: (k, n, 3, 3)."""
        pointwise, state = self.equilibrium.pointwise, self.state
        if pointwise is None:
            return None
        pointwise.update(stiffness=True)
        derivatives = pointwise.tissue.repulsion.derivatives
        assert derivatives is not None
        cells, F = state.cells.point_cells, state.elastic_gradient()
        C = np.swapaxes(F, 1, 2) @ F
        tissue = self.equilibrium.parameters.at_points()
        unit = derivatives(C, state.cells.structure_tensor().reshape(-1, 3, 3), False)[0]
        found = np.empty((len(dimensions), *C.shape))
        for k, change in enumerate(dimensions.reshape(len(dimensions), -1, 3)):
            step = {name: 1j * _COMPLEX_STEP * way[k] for name, way in directions.tissue.items()}
            changed = tissue.map(lambda name, value, step=step: value + step.get(name, 0.0))  # type: ignore[misc]
            modulus = np.imag(changed.repulsion_modulus) / _COMPLEX_STEP
            weighted = (2 * cells.dimensions * change)[:, :, None] * cells.axes
            structure = np.swapaxes(cells.axes, 1, 2) @ weighted
            found[k] = -modulus[:, None, None] * unit
            found[k] -= tissue.repulsion_modulus[:, None, None] * derivatives(C, structure, False)[0]
        return found


# ---------------------------------------------------------------- passes
class Changes(NamedTuple):
    """Of a target, with k unknowns: dE on the diagonal (k, n, 3), ds (k, n)."""

    direction: Array
    share: Array


def diagonal(tensors: Array) -> Array:
    """(n, 3) of (n, 3, 3)."""
    return np.einsum("nii->ni", tensors)


def target_changes(drive: Drive, values: Array) -> Changes:
    """Of the law for A, from the change of the driving tensor's diagonal (k, n, 3)."""
    direction, share = tensor_law.target_derivatives(drive.tensor, drive.floor)
    return Changes(
        np.einsum("nij,knj->kni", direction[:, :3, :3], values), np.einsum("nj,knj->kn", share[:, :3], values)
    )


def followed_changes(
    structure: Array, changes: Array, target: Target, of_target: Changes, squared: Array, rate: Array, of_rate: Array
) -> Array:
    """Change (k, n, 3) of the diagonal of `tensor_law.follow`."""
    left = np.exp(-rate * target.share)
    towards = squared[:, None] * diagonal(target.direction)
    of_exponent = of_rate[:, None] * target.share + rate * of_target.share
    found: Array = (
        left[:, None] * changes
        + ((1 - left) * squared)[:, None] * of_target.direction
        + (left * of_exponent)[:, :, None] * (towards - structure)
    )
    return found


def ranked_changes(
    law: RankedFunction, drive: Drive, values: Array, times: tuple[float, float], old: Array, changes: Any, kappa: Array
) -> Array:
    """Change (k, n, 3) of the lengths of a law by rank."""
    of_old, of_values = changes
    e, active = drive.kernels.positive_direction(values, threshold=drive.threshold)
    size = np.linalg.norm(np.where(e > 0, values, 0.0), axis=1)
    pulled = np.where(e > 0, of_values, 0.0) / np.where(active, size, 1.0)[:, None]
    of_direction = pulled - e * np.einsum("ni,kni->kn", e, pulled)[:, :, None]
    r0, tiny = np.reshape(drive.end_to_end_length, (-1, 1)), 1j * _COMPLEX_STEP
    found = law(
        old + tiny * of_old,
        drive.initial_dimensions,
        r0 * (e + tiny * of_direction),
        drive.kappa + tiny * kappa[:, None, None],
        *times,
    )
    return np.where(active[:, None], np.imag(found) / _COMPLEX_STEP, of_old)


# ---------------------------------------------------------------- couplings
class StaggeredDerivatives(Staggered):
    """`Staggered` with the derivatives of its unknowns and cells."""

    directions: Directions
    unknowns: Array
    dimensions: Array
    _linearised: LinearisedEquilibrium
    _driver: Array  # change of the driver's diagonal in the solved state, (k, n, 3)

    def begin(self, directions: Directions, dimensions: Array | None = None) -> None:
        """Before the first step: what changes, and dl of the cells, zero where it is not given."""
        self.directions = directions
        self._linearised = LinearisedEquilibrium(self.equilibrium, self.remodeling, tuple(directions.tissue))
        count, shape = len(directions.kappa), self.state.cells.quadrature.shape
        self.dimensions = np.zeros((count, *shape, 3)) if dimensions is None else dimensions.copy()
        self.unknowns = np.zeros((count, len(self.state.unknown.x.array)))

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time`, and its derivatives."""
        work = super().solve(time, loads)
        self.unknowns, self._driver = self._linearised.solve(self.directions, time, self.dimensions)
        return work

    def remodel(self, time: float) -> float:
        """The pass, and its derivatives."""
        law = self.remodeling.law
        if not law.remodels:
            return super().remodel(time)
        drive, old, change = self.remodeling.drive(self.residual), self._cells(), self._rows()
        times = self.state.time, time
        power = super().remodel(time)
        if law.dimensions is not None:
            places, values = self._places(), diagonal(drive.tensor)
            of_values = np.take_along_axis(self._driver, places[None], axis=2)
            given = np.take_along_axis(values, places, axis=1), times, old.dimensions, (change, of_values)
            self._put(ranked_changes(law.dimensions, drive, *given, self.directions.kappa))
        else:
            assert law.target is not None
            target = law.target(drive)
            self._follow_changes(old, change, target, target_changes(drive, self._driver), times[1] - times[0])
        return power

    # ------------------------------------------------------------ rows of cells, and coordinates
    def _cells(self) -> UnitCell:
        """A copy of the present ones."""
        return UnitCell(*(values.copy() for values in self.state.cells.point_cells[:2]))

    def _rows(self) -> Array:
        """dl of all points in one row, (k, n, 3)."""
        return self.dimensions.reshape(len(self.dimensions), -1, 3).copy()

    def _put(self, rows: Array) -> None:
        self.dimensions = rows.reshape(self.dimensions.shape)

    def _places(self, axes: Array | None = None) -> Any:
        """Coordinate along which each axis of the cells lies, (n, 3)."""
        axes = self.state.cells.point_cells.axes if axes is None else axes
        return np.abs(axes).argmax(axis=2)

    def _follow_changes(self, old: UnitCell, change: Array, target: Target, of_target: Changes, time: float) -> None:
        """dl of the present cells, which the old ones with their dl (k, n, 3) have become by following a target."""
        count, shape = len(old.dimensions), change.shape
        places = self._places(old.axes)
        structure, changes = np.empty((count, 3)), np.empty(shape)
        np.put_along_axis(structure, places, old.dimensions**2, axis=1)
        np.put_along_axis(changes, np.broadcast_to(places, shape), 2 * old.dimensions * change, axis=2)
        r0 = np.broadcast_to(self.remodeling.parameters.at_points().end_to_end_length, count)
        rate = np.full(count, self.remodeling.kappa * time)
        found = followed_changes(
            structure, changes, target, of_target, r0**2, rate, self.directions.kappa * time
        )  # fmt: skip
        lengths = self.state.cells.point_cells.dimensions
        along = np.take_along_axis(found, np.broadcast_to(self._places(), shape), axis=2)
        self._put(np.divide(along, 2 * lengths, out=np.zeros(shape), where=lengths > 0))


class ExtrapolatedDerivatives(Extrapolated, StaggeredDerivatives):
    """`Extrapolated` with the same: its solves are those of `StaggeredDerivatives`, by the order of the classes."""

    _of_targets: Array  # d(sE) on the diagonal, of the last target and of the one before, (2, k, n, 3)
    _of_start: Array  # dl of the cells at the start of the step, (k, n, 3)

    def begin(self, directions: Directions, dimensions: Array | None = None) -> None:
        """There has been no target."""
        super().begin(directions, dimensions)
        self._of_targets = np.zeros((2, *self._rows().shape))

    def solve(self, time: float, loads: LoadValues) -> Work:
        """New cells, equilibrium at `time` with them, and its derivatives."""
        self._of_start, self._solved = self._rows(), False
        return super().solve(time, loads)

    def _follow(self, target: Target, time: float) -> None:
        """With dl of the cells: from their start towards the extrapolated target, or towards one of this step."""
        changes = self._of_extrapolated(time)
        if self._solved:
            found, begins = self._of_found(), self._begins
            direction = np.where(begins[:, None], found.direction, changes.direction)
            changes = Changes(direction, np.where(begins, found.share, changes.share))
        self._solved = True
        self._put(self._of_start)
        super()._follow(target, time)
        if target.share.any():
            self._follow_changes(self._start, self._of_start, target, changes, time - self.state.time)

    def _of_found(self) -> Changes:
        """Of the target of the solved state."""
        return target_changes(self.remodeling.drive(self.residual), self._driver)

    def _of_extrapolated(self, time: float) -> Changes:
        """As `Target.towards` has it: sE changes linearly, and s is its trace."""
        back = self._back(time)[:, None]
        last, before = (known.share[:, None] * diagonal(known.direction) for known in (self._known(0), self._known(1)))
        both, (of_last, of_before) = last - back * (before - last), self._of_targets
        of_both, share = of_last - back * (of_before - of_last), both.sum(axis=1)
        of_share, some = of_both.sum(axis=2), share > 0.0
        inverse = 1 / np.where(some, share, 1.0)[:, None]
        of_direction = (of_both - both * inverse * of_share[:, :, None]) * inverse
        return Changes(np.where(some[:, None], of_direction, 0.0), np.where(some & (share < 1.0), of_share, 0.0))

    def remodel(self, time: float) -> float:
        """Remember the target of the solved state and its change."""
        changes, found = self._of_found(), self._found
        self._of_targets[1] = self._of_targets[0]
        direction = changes.share[:, :, None] * diagonal(found.direction)
        self._of_targets[0] = direction + found.share[:, None] * changes.direction
        return Extrapolated.remodel(self, time)


COUPLINGS_WITH_DERIVATIVES = {"staggered": StaggeredDerivatives, "extrapolated": ExtrapolatedDerivatives}
"""By the name of the coupling whose steps they make."""


def with_derivatives(name: str, directions: Directions, dimensions: Array | None = None) -> Maker:
    """What makes a coupling of this name with derivatives, which begin with dl (k, elements, points, 3), or zero."""
    kind = COUPLINGS_WITH_DERIVATIVES[name]

    def make(state: State, tissue: Tissue, remodeling: RemodelingPass, solver: Solver) -> Any:
        coupling = kind(state, tissue, remodeling, solver)
        coupling.begin(directions, dimensions)
        return coupling

    return make
