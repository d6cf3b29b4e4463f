"""Elements that hold a body back: by a stiff bulk (they lock), or because the strain varies too much inside them."""

from __future__ import annotations

import logging
from typing import NamedTuple

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.state.memory import Numbers, Occasions
from remodel_fenicsx.state.parameters import at_points

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# The part of its way that a body lacks, from which it is said. docs/locking.md: estimate and error over lambda/mu and
# radii; the paper's bodies come to 3.6 % (artery with random cells, t = 5)
LIMIT = 0.05
# Of the matrix's energy: with less work it is not the loads that deform the body, but its cells. Elastic tubes have at
# least 0.93 (up to 0.9 of the pressure that bursts them), the paper's bodies 1.4
DRIVEN = 0.9
# Jumps between linear elements count so many times: at a wall, where strain varies most, an element has neighbours on
# one side, and half of the jump
JUMPS = 4.0
NEWS = 0.1  # relative change of energies from which on the work, an assembly, is asked for again


class Missing(NamedTuple):
    """About which part of its way a body lacks: by changes of volume, and by changes of shape, inside elements."""

    volume: float
    shape: float


class LockingWarning(Watcher):
    """Says once that elements hold the body back, as soon as a solved state shows it.

    What an element cannot represent costs work. Two integrals over the body estimate how much,

        volume = int lambda/2 (ln J - ln J_e)^2 dV / (f . u / 2),    J_e the element's,
        shape  = int mu |F - F_e|^2 dV / (f . u / 2),                F_e the element's,

    f the internal nodal forces: ln J_e is the mean of ln J over the element, F_e the polynomial through F of one degree
    less than the displacement. An element that cannot keep its volume spends all of `volume` in vain. Of the strain
    that it cannot follow, `shape` counts twice what it has: about as much again is what it lacks (in a thick tube the
    radial strain, constant in an element, beside the circumferential one). Their sum is about the part of its way that
    the body lacks. (The stored energy is no scale: chains have some without any load.)

    Parameters
    ----------
    stepper
        Whose states are looked at.
    locks
        Whether differences of J inside an element cost energy (`Formulation.locks`).
    """

    def __init__(self, stepper: Stepper, locks: bool):
        self.stepper, self.quadrature = stepper, stepper.state.cells.quadrature
        tissue = at_points(stepper.tissue, self.quadrature)
        shape = self.quadrature.shape
        self.stiffnesses = [self.quadrature.owned(v.reshape(shape)) for v in (tissue.lame_lambda, tissue.lame_mu)]
        self.locks = locks
        self.homogeneous = stepper.state.kinematics.homogeneous  # then there are no elements that could hold it back
        self._occasions = Occasions(stepper.state, "locking")
        self._numbers = Numbers(stepper.state, "locking", {"said": 0, "energy": 0, "vain": 0})

    def stiffness_ratio(self) -> float:
        """Largest lambda/mu in the body."""
        return self.quadrature.maximum(self.stiffnesses[0] / self.stiffnesses[1])

    def missing(self) -> Missing:
        """Of the present state; zero where the loads do not drive it."""
        energy, *vain = self.energies()
        work = self.work()
        return Missing(*(part / work for part in vain)) if work > DRIVEN * energy > 0 else Missing(0.0, 0.0)

    def energies(self) -> tuple[float, float, float]:
        """Of the matrix, with the mean J of each element; of changes of J inside; twice that of changes of F there."""
        quadrature, (stiffness, shear) = self.quadrature, self.stiffnesses
        states = self.stepper.coupling.equilibrium.look().states.reshape(*stiffness.shape, 11)
        logarithm, F = np.log(states[..., 1]), states[..., 2:]
        inside = quadrature.beyond(0, logarithm[..., None])[..., 0]
        matrix = stiffness * (logarithm - inside) ** 2 + shear * (np.square(F).sum(axis=-1) - 3 - 2 * logarithm)
        volume = stiffness * np.square(inside) * self.locks
        shape = 2 * shear * np.square(quadrature.beyond(quadrature.element_degree - 1, F)).sum(axis=-1)
        shape *= self._followed(shape, F)[:, None]
        weights = quadrature.owned(quadrature.volumes) / 2
        local = np.array([float((part * weights).sum()) for part in (matrix, volume, shape)])
        first, second, third = self.stepper.state.comm.allreduce(local, MPI.SUM).tolist()
        return first, second, third

    def _followed(self, shape: Array, F: Array) -> Array:
        """Which part of `shape` counts, by element: strain that linear elements do follow has no jumps between them.

        The strain of a twisted bar varies inside its elements, which have it exactly. What elements of degree 1 lack
        jumps between them by as much as it varies. Elements of degree 2 err alike where they meet, and a linear strain
        is none that they could lack.
        """
        quadrature = self.quadrature
        if quadrature.element_degree > 1 or quadrature.shape[1] == 1:
            return np.ones(len(F))
        weights = quadrature.owned(quadrature.volumes)
        shear = (self.stiffnesses[1] * weights).sum(axis=1) / weights.sum(axis=1)
        inside = (shape * weights).sum(axis=1) / weights.sum(axis=1)
        jumps = JUMPS * 2 * shear * quadrature.jumps(F)
        return np.asarray(np.minimum(1.0, jumps / np.maximum(inside, np.finfo(float).tiny)))

    def work(self) -> float:
        """Half of the internal nodal forces times the unknowns: the work of loads and supports if all were linear."""
        state, forms = self.stepper.state, self.stepper.coupling.equilibrium.internal_forms
        # shares of the ranks in a node's force are not added up: their sum over all ranks is the same
        local = sum(float(dolfinx.fem.assemble_vector(form).array @ state.unknown.x.array) for form in forms)
        return float(state.comm.allreduce(local, MPI.SUM)) / 2

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.homogeneous or self._numbers["said"] or not self._occasions.due() or not self._is_news():
            return
        missing = self.missing()
        if sum(missing) <= LIMIT:
            return
        self._numbers["said"] = True
        if self.stepper.state.comm.rank == 0:
            log.warning("time %g: %s", step.time, self.in_words(missing))

    def _is_news(self) -> bool:
        """Whether energies differ from those of the last look."""
        energy, *vain = self.energies()
        known = self._numbers["energy"], self._numbers["vain"]
        news = any(abs(now - old) > NEWS * old for now, old in zip((energy, sum(vain)), known, strict=True))
        if news:
            self._numbers["energy"], self._numbers["vain"] = energy, sum(vain)
        return news

    def in_words(self, missing: Missing) -> str:
        """What holds the body back, by how much, and what to set."""
        lacks = f"the body moves about {100 * min(sum(missing), 1.0):.2g} % too little"
        if missing.volume >= missing.shape:
            return (
                f"the elements lock, {lacks} (lambda/mu up to {self.stiffness_ratio():.4g}); set mesh.element = "
                "'hexahedron' and mesh.formulation = 'selective-integration' (docs/theory.md, Volumetric locking)"
            )
        return (
            f"the elements are too large, {lacks}: strain varies inside them by more than they can follow; set "
            "mesh.degree = 2 or a larger mesh.refinement (docs/theory.md, Volumetric locking)"
        )
