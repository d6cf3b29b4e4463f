"""The remodeling pass: driving tensor of the solved state, evolution law, new cells (paper, eqs. 8 to 11)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import ufl
from dolfinx.fem import Function
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import Remembered, coefficient, over_ranks, point_values
from remodel_fenicsx.kernels import TensorKernels, in_numpy
from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, angle_between, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES, carried_axes
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import Drive, LAWS, MEANS_OF_CASES, mean_target, relaxed, tensor_target
from remodel_fenicsx.model.tensor_law import ABOVE_ROUNDING, Target, floor_above
from remodel_fenicsx.schema.settings import COUPLINGS, Remodeling
from remodel_fenicsx.solver.equilibrium import PointStresses
from remodel_fenicsx.state import Numbers, State, stress_rounding

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

RESIDUAL_SHARE = 20.0  # an eighth of an element's nodes share a face's force; a pulled-back stress is larger still
TYPICAL_SHARE = 1e-2  # of the body's stress: the most that the residual counts as; tension below it is none of weight
# Of the body's stress, from which on the residual is said. The artery on one radius, law "tensor": at 0.02 to 0.05
# radii are within 0.1 %, at 0.4 they are 2 % off
WORTH_A_WORD = 0.1
STRESS_ROUNDINGS = 64.0  # how many times the rounding of a stress its principal values may be off
AWAKE = 0.5  # of the speed of remodeling under tension alone
LOOSE_SOLVER = (
    "solver tolerance: the out-of-balance forces may be stresses of up to %.2g, the stresses of the body are %.2g. "
    "Stresses up to %.2g do not count as tension; lower solver.relative_tolerance or solver.absolute_tolerance"
)


class Noise(NamedTuple):
    """Size up to which a principal value of the driving tensor may be an error, in its unit."""

    size: float
    rounding: float


class RemodelingPass(Remodels):
    """Updates the unit cells of a solved state."""

    name, components = "cells", len(tensors.MANDEL)

    def __init__(
        self,
        state: State,
        tissue: Tissue,
        settings: Remodeling,
        kappa: float | Function | None = None,
        beside: Sequence[Remodels] = (),
    ):
        self.state, self.settings, self.beside = state, settings, list(beside)  # beside: what else remodels
        self.quadrature = state.cells.quadrature
        # drives of states beside this one, which have the same cells
        self.further: list[Callable[[], Drive]] = []
        # of a pass's change of the cells that is made
        self.relaxation = settings.relaxation_factor if COUPLINGS[settings.coupling].makes_a_share else 1.0
        self.parameters = state.parameters(tissue)
        self.driver, self.law, self.frame = DRIVERS[settings.driver], LAWS[settings.law], FRAMES[settings.frame]
        self.set_kappa(settings.kappa if kappa is None else kappa)
        if self.fastest == 0.0 and self.law.asks_kappa:  # cells that never move need no pass
            self.law = LAWS["none"]
        if not self.law.remodels:
            return
        self._change: tuple[UnitCell, UnitCell] | None = None
        self.kernels = state.cells.kernels
        self._numbers = Numbers(state, "noise", {"said": 0, "stress": 0.0, "floor": 0.0})
        self._smallest_area = self.quadrature.minimum(self.quadrature.smallest_areas)
        F = state.kinematics.elastic_gradient(state.unknown)
        self.stresses = PointStresses(state, tissue)
        tensor = ufl.as_ufl(self.driver.tensor(F, self.stresses.ufl))
        self._expression = jit.expression(tensor, self.quadrature.points)
        self._known: Remembered[Array] = Remembered(state.comm, tensor)
        self._target = self.law.target
        if self._target is tensor_target and not settings.has_set_point and not in_numpy():
            self._target = TensorKernels(state.comm).target  # with the exponent 2 and no threshold

    @property
    def changes(self) -> bool:  # type: ignore[override]
        """Whether cells change at all."""
        return self.law.remodels

    @property
    def depends_on_path(self) -> bool:  # type: ignore[override]
        """Whether cells stay where tension is below a threshold."""
        return self.settings.threshold > 0.0

    def set_kappa(self, kappa: float | Function) -> None:
        """A number, or a DG0 Function."""
        if not isinstance(kappa, Function):
            self.kappa: Array | float = kappa
            self.slowest = self.fastest = kappa
            return
        at_points = point_values(coefficient(self.quadrature.mesh, "kappa", kappa), self.quadrature)
        self.fastest = self.quadrature.maximum(at_points)
        slowest = self.quadrature.minimum(np.where(at_points > 0.0, at_points, np.inf))
        self.slowest, self.kappa = slowest if np.isfinite(slowest) else 0.0, at_points.reshape(-1)

    def driving_tensor(self) -> tuple[Array, Array]:
        """F_e and the symmetric driving tensor at all points, each (elements * points, 3, 3)."""

        def evaluated() -> Array:
            self.stresses.refresh()
            tensor = self.quadrature.evaluate(self._expression, (3, 3)).reshape(-1, 3, 3)
            return (tensor + np.swapaxes(tensor, 1, 2)) / 2

        return self.state.elastic_gradient(), self._known(evaluated)

    def drive(self, residual: float = 0.0) -> Drive:
        """What acts on the cells in the present state, which was accepted with this norm of out-of-balance forces."""
        # Of several states with the same cells: their mean.
        if not self.further:
            return self._own_drive(residual)
        return MEANS_OF_CASES[self.settings.mean].drive(self._drives(residual), self.state.weights)

    def _drives(self, residual: float) -> list[Drive]:
        return [self._own_drive(residual), *(drive() for drive in self.further)]

    def _own_drive(self, residual: float) -> Drive:
        F, tensor = self.driving_tensor()
        noise, rounding = self.noise(F, tensor, residual)
        # the driver's principal axes if the cells' axes are to stay
        steady = self.state.cells.point_cells.axes
        if not self.driver.material and self.frame.carries_axes:
            steady = carried_axes(F, steady)
        return Drive(
            F,
            self.kernels.without_noise(tensor, steady, noise),
            self.driver,
            self.frame,
            noise,
            self.state.cells.initial_dimensions.reshape(-1, 3),
            self.parameters.at_points().end_to_end_length,
            self.kappa,
            pairing=spectral.PAIRINGS[self.settings.pairing],
            rotation_time=self.settings.rotation_time,
            kernels=self.kernels,
            rounding=rounding,
            exponent=self.settings.exponent,
            least_tension=self.settings.threshold,
            parameters=self.settings.own_parameters,
        )

    def noise(self, F: Array, tensor: Array, residual: float) -> Noise:
        """Up to which size a principal value may be an error: of rounding, or of the equilibrium as it was accepted."""
        # The residual is one number for the whole body, of which nobody knows what stress it means at a point. However
        # loose the tolerance is, it must not decide that nothing remodels: it counts as a small share of the stress.
        if not self.driver.is_stress:
            return Noise(spectral.ROUNDING, spectral.ROUNDING)
        rounding = STRESS_ROUNDINGS * stress_rounding(self.parameters.largest(), self._max_chain_extension(F))
        displacement = float(np.abs(self.state.unknown.x.array).max(initial=0.0))
        displacement = over_ranks(self.state.comm, displacement, MPI.MAX)
        rounded = rounding * (1 + self.quadrature.largest_gradient * displacement)
        squares = np.sum(tensor**2, axis=(1, 2)).reshape(self.quadrature.shape)
        typical = float(np.sqrt(self.quadrature.mean(squares)))
        unbalanced = RESIDUAL_SHARE * residual / self._smallest_area
        most = max(TYPICAL_SHARE * typical, ABOVE_ROUNDING * rounded)
        if unbalanced > max(WORTH_A_WORD * typical, most) and not self._numbers["said"]:
            self._numbers["said"] = 1
            if self.state.comm.rank == 0:
                log.warning(LOOSE_SOLVER, unbalanced, typical, most)
        noise = Noise(rounded + min(unbalanced, most), rounding)
        if self.law.target is not None and typical > self._numbers["stress"]:
            self._numbers["stress"], self._numbers["floor"] = typical, float(floor_above(*noise))
        return noise

    def weakness(self) -> float:
        """Tension of which half counts, over the stress of the body when that was largest; 0 of what nothing loads."""
        # Laws that follow a target by its share are slower there (`tensor_law.floor_above`).
        if not self.law.remodels or self.law.target is None or not self.driver.is_stress:
            return 0.0
        stress, floor = self._numbers["stress"], self._numbers["floor"]
        return floor / stress if stress * ABOVE_ROUNDING > floor else 0.0

    def _max_chain_extension(self, F: Array) -> float:
        length = self.parameters.at_points().locking_length
        if length is None:
            return 0.0
        squared = self.kernels.squared_length(F, self.state.cells.point_cells) / length**2
        return float(np.sqrt(self.quadrature.maximum(squared.reshape(self.quadrature.shape))))

    def updated_cells(
        self, time_old: float, time_new: float, residual: float = 0.0, cells: UnitCell | None = None
    ) -> tuple[UnitCell, Array]:
        """What the present stress makes of the present cells, or of others, in one row, and F (n, 3, 3)."""
        # Changes nothing.
        cells = self.state.cells.point_cells if cells is None else cells
        if self._averages_targets:
            followed = self.followed(self.target(residual), time_new - time_old, cells)
            return followed, self.state.elastic_gradient()
        drive = self.drive(residual)
        return self.law.update(cells, drive, time_old, time_new), drive.deformation_gradient

    def target(self, residual: float = 0.0) -> Target:
        """What the structure tensor tends to in the present state; of laws that have one."""
        assert self._target is not None
        if self._averages_targets:
            return mean_target([self._target(drive) for drive in self._drives(residual)], self.state.weights)
        return self._target(self.drive(residual))

    @property
    def _averages_targets(self) -> bool:
        return bool(self.further) and MEANS_OF_CASES[self.settings.mean].of_targets

    def without_tension(self, residual: float = 0.0) -> NDArray[np.bool_]:
        """Of all points in one row: those without tension, or with hardly any beside compression. Cells there stay."""
        drive = self.drive(residual)
        if self.law.target is not None:
            return np.asarray(self.target(residual).switch < AWAKE)
        values = np.linalg.eigvalsh(drive.tensor)
        return ~spectral.positive_direction(values, threshold=drive.noise)[1]

    def asleep_share(self) -> float:
        """Share of the body's volume in which no principal value is above `remodeling.threshold`."""
        tensor = self.drive().tensor if self.further else self.driving_tensor()[1]
        asleep = np.linalg.eigvalsh(tensor)[:, -1] <= self.settings.threshold
        return float(self.quadrature.mean(asleep.reshape(self.quadrature.shape).astype(float)))

    def followed(self, target: Target, duration: float, cells: UnitCell | None = None) -> UnitCell:
        """Cells of all points in one row, the present or others, after a time with this target. Changes nothing."""
        assert self.law.follow is not None
        r0 = self.parameters.at_points().end_to_end_length
        return self.law.follow(cells or self.state.cells.point_cells, target, r0, self.kappa * duration)

    @property
    def asked(self) -> UnitCell | None:
        """What the last pass has asked for, whatever share of it was made; None before it."""
        return self._change[1] if self.law.remodels and self._change is not None else None

    def apply(self, time_old: float, time_new: float, residual: float = 0.0) -> float:
        """Remodel over a step with the stress of the solved state at time_new; returns the power of remodeling."""
        # The power is the stored energy that the pass releases at frozen deformation, per time, to first order
        # (`Tissue.energy_increment`; Remark 6). A principal stress counts as tension beyond `noise`. Of the change of
        # the cells the share `relaxation` is made (`Law.share`).
        asked, F = self.updated_cells(time_old, time_new, residual)
        return self.replace(asked, F, time_new - time_old, self.relaxation)

    def replace(self, asked: UnitCell, F: Array, duration: float, factor: float = 1.0) -> float:
        """Give the state other cells, or a share of the change; returns the power of remodeling at frozen F."""
        cells = self.state.cells
        self._change = cells.point_cells.copy(), asked
        updated = self.law.share(self._change[0], asked, factor)
        increment = self.parameters.at_points().energy_increment(F, self._change[0], updated)
        power: float = 0.0 - self.quadrature.integral(self.state.per_mesh_volume(increment)) / duration
        cells.set(*updated[:2])
        return power

    def look_ahead(self, time: float, residual: float = 0.0) -> None:
        """What a pass to the limit would make of the present cells, for `residual`; nothing changes."""
        # at rest the time is so long that nothing is left of a start (`Scene.last_time`): as much again is the limit
        asked, _ = self.updated_cells(time, 2 * time, residual)
        self._change = self.state.cells.point_cells.copy(), asked

    def distance(self) -> float:
        """max |A_pass - A| of the last pass over all points, A those of the solved state, in squared link lengths."""
        # How far the solved state is from one whose cells belong to its own stress; NaN before the first pass.
        if not self.law.remodels or self._change is None:
            return float("nan")
        before, after = (structure_tensor(*cells[:2]) for cells in self._change)
        distance = np.linalg.norm(after - before, axis=(-1, -2))
        return self.quadrature.maximum(distance.reshape(self.quadrature.shape))

    # ------------------------------------------------------------ as one of those that remodel
    def row(self) -> UnitCell:
        """Return the cells of the solved state."""
        return UnitCell(*self.state.equilibrium_cells.point_cells[:2])

    def set(self, values: UnitCell) -> None:
        """Replace the cells at all points."""
        self.state.cells.set(*values[:2])

    def as_components(self, values: UnitCell) -> Array:
        """Return Mandel components of A."""
        return tensors.to_mandel(structure_tensor(*values[:2]))

    def moved(self, values: UnitCell, change: Array) -> UnitCell:
        """Return cells whose A has changed."""
        squared, axes = spectral.continued(structure_tensor(*values[:2]) + tensors.from_mandel(change), values.axes)
        return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)

    def passed(self, values: UnitCell, time: float, residual: float) -> UnitCell:
        """Return the cells after a pass."""
        return self.updated_cells(self.state.time, time, residual, values)[0] if self.law.remodels else values

    def apart(self, values: UnitCell, other: UnitCell) -> float:
        """Return the angle between the directions of the chains, root mean square over the body."""
        angles = angle_between(values, other).reshape(self.quadrature.shape)
        return float(np.sqrt(self.quadrature.mean(angles**2)))

    def left(self, time: float, residual: float) -> float:
        """Return the largest change of A by a pass, over r0^2."""
        return self.size(self._change_by_a_pass(time, residual))

    def to_the_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change of A by a pass to a time, at points that have tension."""
        change = self._change_by_a_pass(time, residual)
        change[self.without_tension(residual).reshape(self.quadrature.shape)] = 0.0
        return change

    def size(self, change: Array) -> float:
        """Return the largest change of A over r0^2."""
        r0 = self.parameters.at_points().end_to_end_length.reshape(self.quadrature.shape)
        return self.quadrature.maximum(np.linalg.norm(change, axis=(-1, -2)) / r0**2)

    def follow(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Make a multiple of the change of a pass to a time."""
        asked, _ = self.updated_cells(self.state.time, time, residual)
        self.set(relaxed(self.state.cells.point_cells.copy(), asked, factor))

    def _change_by_a_pass(self, time: float, residual: float) -> Array:
        """Return that of A, (elements, points, 3, 3)."""
        asked, _ = self.updated_cells(self.state.time, time, residual)
        present = self.state.cells.structure_tensor()
        return np.asarray(structure_tensor(*asked[:2]).reshape(present.shape) - present)
