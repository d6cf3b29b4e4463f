"""Elements that lock in a stiff bulk: how much of the energy is in changes of volume that only the elements make."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.equilibrium import at_points
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.formulations import Locking

log = logging.getLogger(__name__)

UNIFORM = 1e-9  # share of the energy in differences of J up to which they are rounding


class LockingWarning(Watcher):
    """Says once that the elements lock, as soon as a solved state shows it.

    A body can lock where lambda is large beside mu: the network adds nothing to the stiffness against shear between
    the axes of its cells, however stiff it is along them. Whether it does depends on what it is asked to do, and the
    solved state tells. A body that does not lock has next to no energy in changes of volume, of order mu/lambda; in
    one that does J differs from point to point of an element. The share of the stored energy of these differences,

        share = int lambda/2 (ln^2 J - ln^2 J_e) dV / int W dV,   J_e the mean of J over the element,

    is about the share by which loads move the body too little. Elements of a single point have no such differences:
    they count as locked as soon as different elements have different J.

    Parameters
    ----------
    stepper
        Whose states are looked at.
    limits
        From where on its elements lock; None if they never do.
    """

    def __init__(self, stepper: Stepper, limits: Locking | None):
        self.stepper, self.quadrature = stepper, stepper.state.cells.quadrature
        self.tissue = at_points(stepper.tissue, self.quadrature)
        self.limits = limits if limits is not None and self.stiffness_ratio() > limits.stiffness_ratio else None

    def stiffness_ratio(self) -> float:
        """Largest lambda/mu in the body."""
        ratio = self.tissue.lame_lambda / self.tissue.lame_mu
        return self.quadrature.maximum(ratio.reshape(self.quadrature.shape))

    def energy_share(self) -> float:
        """The share of the present state; 0 without energy. In elements of one point: 1 if J varies."""
        quadrature, equilibrium = self.quadrature, self.stepper.coupling.equilibrium
        energy, jacobian = equilibrium.stored_energy(), equilibrium.limit_values()[1]
        if not energy > 0:
            return 0.0
        means = np.broadcast_to(quadrature.element_mean(jacobian)[:, None], jacobian.shape)
        if quadrature.shape[1] > 1:
            return self._volumetric_energy(jacobian, means) / energy
        whole = np.full(jacobian.shape, quadrature.mean(jacobian))
        return float(self._volumetric_energy(jacobian, whole) > UNIFORM * energy)

    def _volumetric_energy(self, jacobian: NDArray[np.float64], means: NDArray[np.float64]) -> float:
        """Energy of J beyond that of the means."""
        stiffness = self.tissue.lame_lambda.reshape(jacobian.shape)
        return self.quadrature.integral(stiffness / 2 * (np.log(jacobian) ** 2 - np.log(means) ** 2))

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.limits is None:
            return
        share = self.energy_share()
        if share <= self.limits.energy_share:
            return
        self.limits = None
        if self.stepper.state.comm.rank == 0:
            inside = f"{100 * share:.2g} % of the stored energy is in changes of volume inside single elements"
            log.warning(
                "time %g: the elements lock, the body moves too little (lambda/mu up to %.4g; %s); set mesh.element = "
                "'hexahedron' and mesh.formulation = 'selective-integration' (docs/theory.md, Volumetric locking)",
                step.time,
                self.stiffness_ratio(),
                "they are linear" if self.quadrature.shape[1] == 1 else inside,
            )
