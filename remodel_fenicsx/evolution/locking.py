"""Elements that lock in a stiff bulk: how much work goes into changes of volume that only elements make."""

from __future__ import annotations

import logging

import dolfinx.fem
import numpy as np
from mpi4py import MPI

from remodel_fenicsx.evolution.parameters import at_points
from remodel_fenicsx.evolution.memory import Numbers
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.formulations import Locking

log = logging.getLogger(__name__)

UNIFORM = 1e-9  # relative differences of J up to which they are rounding


class LockingWarning(Watcher):
    """Says once that the elements lock, as soon as a solved state shows it.

    A body can lock where lambda is large beside mu: the network adds nothing to the stiffness against shear between
    the axes of its cells, however stiff it is along them. Whether it does depends on what it is asked to do, and the
    solved state tells. A body that does not lock spends next to nothing on changes of volume, of order mu/lambda; in
    one that does J differs from point to point of an element. The share of these differences,

        share = int lambda/2 (ln^2 J - ln^2 J_e) dV / (f . u / 2),   J_e the mean of J over the element,

    f the internal nodal forces, is about the share by which loads move the body too little. (The stored energy is no
    scale: chains have some without any load.) Elements of a single point have no such differences: they count as
    locked as soon as different elements have different J.

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
        self._numbers = Numbers(stepper.state, "locking", {"said": 0})

    def stiffness_ratio(self) -> float:
        """Largest lambda/mu in the body."""
        ratio = self.tissue.lame_lambda / self.tissue.lame_mu
        return self.quadrature.maximum(ratio.reshape(self.quadrature.shape))

    def energy_share(self) -> float:
        """The share of the present state; 0 where J is the same all over, else 1 for elements of a single point."""
        quadrature = self.quadrature
        logarithm = np.log(self.stepper.coupling.equilibrium.limit_values()[1])
        single = quadrature.shape[1] == 1
        whole = np.full(len(logarithm), quadrature.mean(logarithm))
        means = (whole if single else quadrature.element_mean(logarithm))[:, None]
        if quadrature.maximum(np.abs(logarithm - means)) < UNIFORM:
            return 0.0
        work = self.work()
        stiffness = self.tissue.lame_lambda.reshape(logarithm.shape)
        energy = quadrature.integral(stiffness / 2 * (logarithm**2 - means**2))
        return 1.0 if single else energy / work if work > 0 else 0.0

    def work(self) -> float:
        """Half of the internal nodal forces times the unknowns: the work of loads and supports if all were linear."""
        state, forms = self.stepper.state, self.stepper.coupling.equilibrium.internal_forms
        # shares of the ranks in a node's force are not added up: their sum over all ranks is the same
        local = sum(float(dolfinx.fem.assemble_vector(form).array @ state.unknown.x.array) for form in forms)
        return float(state.comm.allreduce(local, MPI.SUM)) / 2

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.limits is None or self._numbers["said"]:
            return
        share = self.energy_share()
        if share <= self.limits.energy_share:
            return
        self._numbers["said"] = True
        if self.stepper.state.comm.rank == 0:
            inside = f"{100 * share:.2g} % of the work goes into changes of volume inside single elements"
            log.warning(
                "time %g: the elements lock, the body moves too little (lambda/mu up to %.4g; %s); set mesh.element = "
                "'hexahedron' and mesh.formulation = 'selective-integration' (docs/theory.md, Volumetric locking)",
                step.time,
                self.stiffness_ratio(),
                "they are linear" if self.quadrature.shape[1] == 1 else inside,
            )
