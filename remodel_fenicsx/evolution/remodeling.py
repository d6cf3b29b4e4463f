"""Remodeling pass: driving tensor of the solved state, evolution law, new cells (eqs. 8 to 11)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import ufl
from dolfinx.fem import Function
from mpi4py import MPI

from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import CachedValue, coefficient, allreduce, point_values
from remodel_fenicsx.kernels import TensorKernels, uses_numpy
from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, angle_between, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES, convected_axes
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import (
    cells_from_structure,
    Drive,
    LAWS,
    MEANS_OF_CASES,
    mean_target,
    relaxed,
    tensor_target,
)
from remodel_fenicsx.model.tensor_law import MIN_TENSION_OVER_ROUNDING, Target, switch_threshold
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.schema.settings import COUPLINGS, Remodeling
from remodel_fenicsx.solver.equilibrium import PointStresses
from remodel_fenicsx.state import StateNumbers, State, stress_rounding

log = logging.getLogger(__name__)

# Bound of the stress error, as a multiple of residual / smallest face area. The residual may
# act at one of the eight nodes of an element alone, and then corresponds to a stress of up to 8
# times the force over the face area. A stress that is pulled back to the reference configuration is
# larger still.
RESIDUAL_STRESS_FACTOR = 20.0
# The bound that the residual gives is limited to this fraction of the body's stress, or to the
# error by rounding if that is larger. A tension below the fraction carries hardly any load, and may
# be treated as zero.
MAX_RESIDUAL_STRESS_FRACTION = 1e-2
# A run warns once if (stress of the residual) / (body's stress) exceeds this and the limit above.
# Measured for the artery in one dimension with the law "tensor": ratio 0.02 to 0.05, error of radii
# below 0.1 %; ratio 0.4, error 2 %.
WARNED_RESIDUAL_FRACTION = 0.1
STRESS_ROUNDINGS = 64.0  # error of a principal value as a multiple of a stress's rounding error
MIN_ACTIVATION = 0.5  # switch below which a point counts as a point without tension
LOOSE_SOLVER = (
    "the residual may correspond to stresses of up to %.2g (RMS stress of the body: %.2g); "
    "stresses below %.2g remodel slowly or not at all. Lower solver.relative_tolerance or "
    "solver.absolute_tolerance"
)


class Noise(NamedTuple):
    """Error bounds of principal values of the driving tensor: in total, and by rounding alone."""

    size: float
    rounding: float


class RemodelingPass(Remodels):
    """Remodeling pass, which updates the unit cells of a solved state."""

    name, components = "cells", len(tensors.MANDEL)

    def __init__(
        self,
        state: State,
        tissue: Tissue,
        settings: Remodeling,
        kappa: float | Function | None = None,
        additional_processes: Sequence[Remodels] = (),
    ):
        self.state, self.settings = state, settings
        self.additional_processes = list(additional_processes)
        self.quadrature = state.cells.quadrature
        # Drives of further load cases, which have the same cells.
        self.further: list[Callable[[], Drive]] = []
        # Relaxation factor of a pass's change of the cells.
        self.relaxation = (
            settings.relaxation_factor if COUPLINGS[settings.coupling].relaxes else 1.0
        )
        self.parameters = state.parameters(tissue)
        self.driver, self.law = DRIVERS[settings.driver], LAWS[settings.law]
        self.frame, self._own_parameters = FRAMES[settings.frame], settings.own_parameters
        self.set_kappa(settings.kappa if kappa is None else kappa)
        if (
            self.fastest == 0.0 and self.law.stops_at_zero_kappa
        ):  # cells that never change need no pass
            self.law = LAWS["none"]
        if not self.law.remodels:
            return
        # Cells before the last pass, and after it without relaxation.
        self._last_pass: tuple[UnitCell, UnitCell] | None = None
        self.kernels = state.cells.kernels
        self._numbers = StateNumbers(state, "noise", {"said": 0, "stress": 0.0, "floor": 0.0})
        self._smallest_area = self.quadrature.minimum(self.quadrature.smallest_areas)
        F = state.kinematics.elastic_gradient(state.unknown)
        self.stresses = PointStresses(state, tissue)
        tensor = ufl.as_ufl(self.driver.tensor(F, self.stresses.ufl))
        self._expression = jit.expression(tensor, self.quadrature.points)
        self._cached_tensor: CachedValue[Array] = CachedValue(state.comm, tensor)
        self._target = self.law.target
        if (
            self._target is tensor_target
            and not settings.changes_exponent_or_threshold
            and not uses_numpy()
        ):
            self._target = TensorKernels(state.comm).target  # exponent 2, no threshold

    @property
    def changes(self) -> bool:  # type: ignore[override]
        """Whether the cells change in time."""
        return self.law.remodels

    @property
    def depends_on_path(self) -> bool:  # type: ignore[override]
        """Whether the steady state depends on the load path: with a threshold it does."""
        return self.settings.threshold > 0.0

    def set_kappa(self, kappa: float | Function) -> None:
        """Set the rate kappa to a number or a DG0 Function. Collective."""
        if not isinstance(kappa, Function):
            self.kappa: Array | float = kappa
            self.slowest = self.fastest = kappa
            return
        at_points = point_values(coefficient(self.quadrature.mesh, "kappa", kappa), self.quadrature)
        self.fastest = self.quadrature.maximum(at_points)
        slowest = self.quadrature.minimum(np.where(at_points > 0.0, at_points, np.inf))
        self.slowest, self.kappa = slowest if np.isfinite(slowest) else 0.0, at_points.reshape(-1)

    def driving_tensor(self) -> tuple[Array, Array]:
        """Return F_e and the symmetric driving tensor, each (elements * points, 3, 3)."""

        def evaluated() -> Array:
            self.stresses.refresh()
            tensor = self.quadrature.evaluate(self._expression, (3, 3)).reshape(-1, 3, 3)
            return (tensor + np.swapaxes(tensor, 1, 2)) / 2

        return self.state.elastic_gradient(), self._cached_tensor(evaluated)

    def drive(self, residual: float = 0.0) -> Drive:
        """Return what a law needs from the present state, accepted with this residual norm."""
        # With further load cases it is the mean over all cases.
        if not self.further:
            return self._own_drive(residual)
        return MEANS_OF_CASES[self.settings.mean].drive(self._drives(residual), self.state.weights)

    def _drives(self, residual: float) -> list[Drive]:
        return [self._own_drive(residual), *(drive() for drive in self.further)]

    def _own_drive(self, residual: float) -> Drive:
        F, tensor = self.driving_tensor()
        noise, rounding = self.noise(F, tensor, residual)
        cells = self.state.cells
        # Axes that the driver would have if the cells did not rotate.
        steady = cells.point_cells.axes
        if not self.driver.material and self.frame.carries_axes:
            steady = convected_axes(F, steady)
        return Drive(
            F,
            self.kernels.drop_noise_shear(tensor, steady, noise),
            self.driver,
            self.frame,
            noise,
            cells.initial_dimensions.reshape(-1, 3),
            self.parameters.at_points().end_to_end_length,
            self.kappa,
            pairing=spectral.PAIRINGS[self.settings.pairing],
            rotation_time=self.settings.rotation_time,
            kernels=self.kernels,
            rounding=rounding,
            exponent=self.settings.exponent,
            least_tension=self.settings.threshold,
            parameters=self._own_parameters,
        )

    def noise(self, F: Array, tensor: Array, residual: float) -> Noise:
        """Return the error bound of principal values from rounding and the accepted residual."""
        # The residual is one number for the whole body, and its stress at a point is unknown. A
        # loose tolerance must not stop all remodeling. Therefore the residual counts as a small
        # fraction of the stress at most.
        if not self.driver.is_stress:
            return Noise(spectral.ROUNDING, spectral.ROUNDING)
        rounding = STRESS_ROUNDINGS * stress_rounding(
            self.parameters.largest(), self._max_chain_extension(F)
        )
        state = self.state
        displacement = float(np.abs(state.unknown.x.array).max(initial=0.0))
        displacement = allreduce(state.comm, displacement, MPI.MAX)
        rounded = rounding * (1 + self.quadrature.largest_gradient * displacement)
        squares = np.sum(tensor**2, axis=(1, 2)).reshape(self.quadrature.shape)
        typical = float(np.sqrt(self.quadrature.mean(squares)))
        unbalanced = RESIDUAL_STRESS_FACTOR * residual / self._smallest_area
        limit = max(MAX_RESIDUAL_STRESS_FRACTION * typical, MIN_TENSION_OVER_ROUNDING * rounded)
        if (
            unbalanced > max(WARNED_RESIDUAL_FRACTION * typical, limit)
            and not self._numbers["said"]
        ):
            self._numbers["said"] = 1
            if state.comm.rank == 0:
                log.warning(LOOSE_SOLVER, unbalanced, typical, limit)
        noise = Noise(rounded + min(unbalanced, limit), rounding)
        if self.law.target is not None and typical > self._numbers["stress"]:
            self._numbers["stress"], self._numbers["floor"] = typical, float(
                switch_threshold(*noise)
            )
        return noise

    def relative_switch_threshold(self) -> float:
        """Return the switch threshold, relative to the body's largest RMS stress so far."""
        # It is 0 without loads, or while that stress is itself a rounding error. Laws with a target
        # remodel at half speed at this tension, and more slowly below it
        # (`tensor_law.switch_threshold`).
        if not self.law.remodels or self.law.target is None or not self.driver.is_stress:
            return 0.0
        stress, floor = self._numbers["stress"], self._numbers["floor"]
        return floor / stress if stress * MIN_TENSION_OVER_ROUNDING > floor else 0.0

    def _max_chain_extension(self, F: Array) -> float:
        length = self.parameters.at_points().locking_length
        if length is None:
            return 0.0
        squared = self.kernels.squared_length(F, self.state.cells.point_cells) / length**2
        return float(np.sqrt(self.quadrature.maximum(squared.reshape(self.quadrature.shape))))

    def updated_cells(
        self, time_old: float, time_new: float, residual: float, cells: UnitCell | None = None
    ) -> tuple[UnitCell, Array]:
        """Compute the cells after a pass from `cells` or the present ones, and F_e (n, 3, 3)."""
        # Cells are flattened over the quadrature points. The state does not change.
        cells = self.state.cells.point_cells if cells is None else cells
        if self._averages_targets:
            remodeled = self.cells_towards(self.target(residual), time_new - time_old, cells)
            return remodeled, self.state.elastic_gradient()
        drive = self.drive(residual)
        return self.law.update(cells, drive, time_old, time_new), drive.deformation_gradient

    def target(self, residual: float = 0.0) -> Target:
        """Return the target of the structure tensor in the present state; the law must have one."""
        assert self._target is not None
        if self._averages_targets:
            return mean_target(
                [self._target(drive) for drive in self._drives(residual)], self.state.weights
            )
        return self._target(self.drive(residual))

    @property
    def _averages_targets(self) -> bool:
        return bool(self.further) and MEANS_OF_CASES[self.settings.mean].of_targets

    def without_tension(self, residual: float) -> Flags:
        """Return flags (n,) of points with no or hardly any tension."""
        drive = self.drive(residual)
        if self.law.target is not None:
            return self.target(residual).switch < MIN_ACTIVATION
        values = np.linalg.eigvalsh(drive.tensor)
        return ~spectral.positive_direction(values, threshold=drive.noise)[1]

    def inactive_fraction(self) -> float:
        """Return the volume fraction without a principal value above `remodeling.threshold`."""
        tensor = self.drive().tensor if self.further else self.driving_tensor()[1]
        inactive = np.linalg.eigvalsh(tensor)[:, -1] <= self.settings.threshold
        return self.quadrature.mean(inactive.reshape(self.quadrature.shape).astype(float))

    def cells_towards(
        self, target: Target, duration: float, cells: UnitCell | None = None
    ) -> UnitCell:
        """Compute the cells after a time with a constant target; default: the present cells."""
        assert self.law.follow is not None
        r0 = self.parameters.at_points().end_to_end_length
        return self.law.follow(
            cells or self.state.cells.point_cells, target, r0, self.kappa * duration
        )

    @property
    def full_pass_cells(self) -> UnitCell | None:
        """Cells of the last pass before relaxation; None before the first pass."""
        return self._last_pass[1] if self.law.remodels and self._last_pass is not None else None

    def apply(self, time_old: float, time_new: float, residual: float = 0.0) -> float:
        """Remodel over a step with the stress of the solved state at time_new; return the power."""
        # The power is the stored energy that the pass releases at frozen deformation, per time, to
        # first order (`Tissue.energy_increment`; Remark 6). The factor `relaxation` applies to the
        # change of the cells (`Law.relax`).
        full_pass, F = self.updated_cells(time_old, time_new, residual)
        return self.replace(full_pass, F, time_new - time_old, self.relaxation)

    def replace(self, full_pass: UnitCell, F: Array, duration: float, factor: float = 1.0) -> float:
        """Replace the cells by those of a relaxed pass; return the power at frozen F_e."""
        cells = self.state.cells
        self._last_pass = cells.point_cells.copy(), full_pass
        updated = self.law.relax(self._last_pass[0], full_pass, factor)
        increment = self.parameters.at_points().energy_increment(F, self._last_pass[0], updated)
        power: float = (
            0.0 - self.quadrature.integral(self.state.per_mesh_volume(increment)) / duration
        )
        cells.set(*updated[:2])
        return power

    def predict_limit(self, time: float, residual: float) -> None:
        """Store the cells that a pass to t -> infinity would give; `distance` uses them."""
        # The state does not change. `time` is so long that the initial cells no longer matter
        # (`Scene.last_time`); a pass up to `2 * time` therefore reaches the limit.
        full_pass, _ = self.updated_cells(time, 2 * time, residual)
        cells = self.state.cells
        self._last_pass = cells.point_cells.copy(), full_pass

    def distance(self) -> float:
        """Return max |A_pass - A| of the last pass, in squared link lengths."""
        # A belongs to the cells before the pass, which with 'extrapolated' are those of the step's
        # start. The distance is zero if a pass reproduces the cells, that is, if they are in
        # equilibrium with their own stress. NaN before the first pass.
        if not self.law.remodels or self._last_pass is None:
            return float("nan")
        before, after = (structure_tensor(*cells[:2]) for cells in self._last_pass)
        distance = np.linalg.norm(after - before, axis=(-1, -2))
        return self.quadrature.maximum(distance.reshape(self.quadrature.shape))

    # ------------------------------------------------------------ life cycle, see `Remodels`
    def solved_values(self) -> UnitCell:
        """Get the cells of the solved state."""
        return UnitCell(*self.state.equilibrium_cells.point_cells[:2])

    def set(self, values: UnitCell) -> None:
        """Replace the cells at all points."""
        self.state.cells.set(*values[:2])

    def as_components(self, values: UnitCell) -> Array:
        """Return the Mandel components of A, (n, 6)."""
        return tensors.to_mandel(structure_tensor(*values[:2]))

    def with_change(self, values: UnitCell, change: Array) -> UnitCell:
        """Return cells after a change of A, in Mandel components."""
        return cells_from_structure(
            structure_tensor(*values[:2]) + tensors.from_mandel(change), values.axes
        )

    def after_pass(self, values: UnitCell, time: float, residual: float) -> UnitCell:
        """Return cells after a pass up to a time."""
        return (
            self.updated_cells(self.state.time, time, residual, values)[0]
            if self.law.remodels
            else values
        )

    def distance_between(self, values: UnitCell, other: UnitCell) -> float:
        """Return the RMS of the angle between chain directions over the body, in degrees."""
        angles = angle_between(values, other).reshape(self.quadrature.shape)
        return float(np.sqrt(self.quadrature.mean(angles**2)))

    def remaining_change(self, time: float, residual: float) -> float:
        """Return the largest change of A/r0^2 by a pass."""
        return self.size(self._change_by_a_pass(time, residual))

    def change_to_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change of A by a pass up to `time`; zero at points without tension."""
        change = self._change_by_a_pass(time, residual)
        change[self.without_tension(residual).reshape(self.quadrature.shape)] = 0.0
        return change

    def size(self, change: Array) -> float:
        """Return the largest change of A/r0^2."""
        r0 = self.parameters.at_points().end_to_end_length.reshape(self.quadrature.shape)
        return self.quadrature.maximum(np.linalg.norm(change, axis=(-1, -2)) / r0**2)

    def apply_change(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Apply a multiple of a new pass, not `change`, which is zero at points without tension."""
        remodeled, _ = self.updated_cells(self.state.time, time, residual)
        cells = self.state.cells
        self.set(relaxed(cells.point_cells.copy(), remodeled, factor))

    def _change_by_a_pass(self, time: float, residual: float) -> Array:
        """Return the change of A by a pass up to a time, (elements, points, 3, 3)."""
        remodeled, _ = self.updated_cells(self.state.time, time, residual)
        present = self.state.cells.structure_tensor()
        return structure_tensor(*remodeled[:2]).reshape(present.shape) - present
