"""Stability of equilibria by the tangent's inertia, and buckling that a reduction cannot show."""

from __future__ import annotations

import itertools
import logging
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from remodel_fenicsx.body.reductions import Strut
from remodel_fenicsx.evolution.stepper import LoadCaseSolver, Step, Stepper, WarnsOnce, Watcher
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.diagnosis import (
    FactorisationFailed,
    Inertia,
    Mode,
    UNSTABLE,
    inertia_without_loads,
)
from remodel_fenicsx.solver.linear import fill_asymmetric
from remodel_fenicsx.state import FieldHistory, StateNumbers

if TYPE_CHECKING:
    from petsc4py import PETSc

    from remodel_fenicsx.scene.scene import Scene

log = logging.getLogger(__name__)

# Number of Newton iterations with a tangent between two counts. A count costs about as much as an
# iteration.
ITERATIONS_BETWEEN_LOOKS = 100
OLD_FACTOR = 1 / 8  # weight of an iteration without a new tangent in this number
# Largest number of unknowns for a count without a request. Above it a factorisation takes minutes
# and gigabytes.
MOST_UNKNOWNS = 200_000
FIRST_INVERSE_ITERATIONS = 3  # later steps do one iteration from the vector of the step before


class EquilibriumStability(Watcher):
    """Watcher that counts negative eigenvalues of the tangent and logs changes. Collective."""

    def __init__(self, stepper: LoadCaseSolver, unstable: str = "warn", every_step: bool = False):
        self.stepper, self.state = stepper, stepper.state
        self.stops, self.every_step = unstable == "stop", every_step or unstable == "stop"
        self.inertia = Inertia(stepper.coupling.equilibrium)
        self._vector = FieldHistory(self.state, "stability_vector", self.state.unknown.copy, 1)
        self.unknowns = int(self.state.comm.allreduce(self.state.number_of_owned_unknowns))
        # The last number of negative eigenvalues, and Newton iterations since the last count.
        self._numbers = StateNumbers(self.state, "stability", {"known": 0, "iterations": 0})

    def close(self) -> None:
        """Free the objects of PETSc."""
        self.inertia.close()

    # ------------------------------------------------------------ as a watcher
    def started(self, step: Step) -> None:
        """Count at the start if every row has the number."""
        if self.every_step:
            step.negative_eigenvalues = self._count()

    def solved(self, step: Step) -> None:
        """Count if a count is due or the curvature is negative."""
        known = int(self._numbers["known"])
        work = step.work
        effort = work.tangents + OLD_FACTOR * max(0, work.newton_iterations - work.tangents)
        self._numbers["iterations"] = iterations = self._numbers["iterations"] + effort
        newton = self.stepper.coupling.newton
        factorisation = newton.linear.factorisation() if work.newton_iterations else None
        suspicious = factorisation is not None and self._curvature(factorisation) < 0 and known == 0
        overdue = iterations >= ITERATIONS_BETWEEN_LOOKS or (step.is_last and iterations > 0)
        if overdue and not suspicious and not self.every_step and self.unknowns > MOST_UNKNOWNS:
            overdue = False
            if step.is_last:
                self._log(
                    logging.INFO,
                    f"the stability of equilibria was not checked: with {self.unknowns} unknowns "
                    "that is done only on request, by the column negative_eigenvalues or "
                    "solver.unstable = 'stop'",
                )
        if not (suspicious or overdue or self.every_step):
            return
        step.negative_eigenvalues = count = self._count()
        if np.isnan(count):
            return
        self._numbers["iterations"] = 0
        if count != known:
            self._numbers["known"] = count
            self._judge(step, known, int(count))

    # ------------------------------------------------------------ messages
    def _count(self) -> float:
        try:
            return self.inertia.negative_eigenvalues()
        except FactorisationFailed as failure:
            self._log(logging.WARNING, f"the stability of the equilibrium is not known: {failure}")
            return float("nan")

    def _judge(self, step: Step, before: int, now: int) -> None:
        if now < before:
            self._log(
                logging.INFO, f"{step.label}: {eigenvalues(now)} of the tangent, {before} before"
            )
            return
        unloaded, scale = self._unloaded
        if now <= unloaded:
            self._log(
                logging.INFO,
                f"{step.label}: {eigenvalues(now)} of the tangent. The unloaded body already "
                f"has {unloaded}, caused by the stress of its initial cells, so this is no loss "
                "of stability",
            )
            return
        text = (
            f"{eigenvalues(now)} of the tangent (before: {before}); "
            f"{described(self.inertia.lowest(), scale)}"
        )
        if self.stops:
            raise StepFailure(
                step.time, f"the equilibrium at {step.label} is unstable: {text}", UNSTABLE
            )
        unstable = (
            f"{step.label}: unstable equilibrium: {text}. A perturbed body would leave this state"
        )
        self._log(logging.WARNING, unstable)

    @cached_property
    def _unloaded(self) -> tuple[int, float]:
        return inertia_without_loads(self.inertia)

    def _log(self, level: int, text: str) -> None:
        if self.state.comm.rank == 0:
            log.log(level, "%s", text)

    def _curvature(self, factorisation: PETSc.PC) -> float:
        """Return the curvature of the stored vector after inverse iteration. Collective."""
        vector, image = factorisation.getOperators()[0].createVecs()
        first = not self._vector.known
        if first:
            fill_asymmetric(vector)
            free = np.isnan(self.inertia.equilibrium.prescribed_values()[: vector.getLocalSize()])
            vector.array[:] *= free  # prescribed unknowns have an eigenvalue of one
        else:
            vector.array[:] = self._vector.values[0][: vector.getLocalSize()]
        curvature = np.inf
        for _ in range(FIRST_INVERSE_ITERATIONS if first else 1):
            factorisation.apply(vector, image)
            size = image.norm()
            if size == 0.0:  # supports and loads prescribe all unknowns
                break
            curvature = image.dot(vector) / size**2
            if not np.isfinite(curvature):
                break
            image.scale(1.0 / size)
            image.copy(vector)
        self._vector.push_owned(vector.array_r)
        vector.destroy()
        image.destroy()
        return float(curvature)


def eigenvalues(number: int) -> str:
    """Return a number of negative eigenvalues as text."""
    return f"{number or 'no'} negative eigenvalue{'' if number == 1 else 's'}"


def described(mode: Mode, unloaded: float) -> str:
    """Return a mode as text, relative to the unloaded body's lowest eigenvalue if positive."""
    place = ", ".join(f"{c:.4g}" for c in mode.place)
    size = (
        f"{mode.eigenvalue / unloaded:.3g} times its unloaded value"
        if unloaded > 0
        else f"{mode.eigenvalue:.3g}"
    )
    return f"the lowest is {size}, and its mode is largest at ({place})"


# ---------------------------------------------------------------- buckling of whole bodies
# Strains of the finite differences of W for stresses and moduli, and their relative error.
STRAINS = {1: 1e-5, 2: 1e-3}
DIFFERENCE_ERROR = 1e-6
# Thrust / Euler's load. It is 0.8 to 1.1 when whole slender tubes lose their stability
# (docs/solver.md, Buckling).
WARNED_LOAD = 0.9
AROUND, ALONG = range(1, 3)


class BucklingWarning(WarnsOnce):
    """Warning that thrust would bend the whole body, which reduced kinematics cannot show."""

    name = "buckling"

    def __init__(self, stepper: Stepper, strut: Strut):
        super().__init__(stepper)
        self.strut = strut
        self._places = self.quadrature.coordinates.reshape(-1, 3)
        self._directions = strut.directions(self._places)

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> BucklingWarning | None:
        strut = (
            scene.geometry.strut(scene.supports.ends) if stepper.state.kinematics.reduced else None
        )
        return None if strut is None else cls(stepper, strut)  # full kinematics show buckling

    def check(self, step: Step | None = None) -> str:
        """Compare the present thrust with Euler's load. Collective."""
        share = self.thrust() / self.euler_load()
        if not share > WARNED_LOAD:
            return ""
        return (
            f"expected buckling: axial thrust is about {share:.2g} times the Euler load. "
            f"Kinematics {self.state.kinematics.name!r} cannot show it; "
            "set model.kinematics = 'full' (docs/solver.md, Buckling)"
        )

    def thrust(self) -> float:
        """Return the thrust of wall and lumen along z. Collective."""
        thrust = -self._integral(self._derivative(ALONG)) / self._length()
        pressure = self.state.loading.lumen_pressure()
        return thrust if self.strut.inner_radius is None else thrust + pressure * self.lumen_area()

    def lumen_area(self) -> float:
        """Return the lumen's present area, from the mean radius of its nodes. Collective."""
        kinematics, unknown = self.state.kinematics, self.state.unknown
        radius = self.strut.inner_radius
        assert radius is not None
        nodes = kinematics.nodal_space(unknown).tabulate_dof_coordinates()
        here = np.isclose(np.linalg.norm(nodes[:, :2], axis=1), radius, rtol=1e-6)
        deformed = np.linalg.norm(
            (nodes + kinematics.nodal_displacement(unknown))[here, :2], axis=1
        )
        total, number = self.state.comm.allreduce(np.array([deformed.sum(), here.sum()]))
        return float(np.pi * (total / number) ** 2)

    def euler_load(self) -> float:
        """Return Euler's load of the present body, pi^2 EI / (k l)^2. Collective."""
        H = np.empty((3, 3, len(self._places)))  # second derivatives of W by logarithmic strains
        for i, j in itertools.combinations_with_replacement(range(3), 2):
            H[i, j] = H[j, i] = self._derivative(i, j)
        coupling = H[:2, ALONG].T[..., None]
        # Where chains nearly lock, the stiffness across them is below the error, even 0.
        compliance = np.linalg.pinv(
            H[:2, :2].transpose(2, 0, 1), rcond=DIFFERENCE_ERROR, hermitian=True
        )
        modulus = H[ALONG, ALONG] - (coupling * (compliance @ coupling)).sum(axis=(1, 2))
        around = np.einsum(
            "nij,nj->ni", self.state.elastic_gradient(), self._directions[:, :, AROUND]
        )
        squares = self.strut.squared_distances(self._places) * np.square(around).sum(axis=1)
        length = self._length()
        return (
            np.pi**2
            * self._integral(modulus * squares)
            / length
            / (self.strut.end_factor * length) ** 2
        )

    def _length(self) -> float:
        return (
            self.strut.length
            * self._integral(self.state.elastic_gradient()[:, 2, 2])
            / self.quadrature.volume
        )

    def _integral(self, values: Array) -> float:
        """Integrate values (n,) over the reference configuration. Collective."""
        return self.quadrature.integral(values.reshape(self.quadrature.shape))

    def _derivative(self, *axes: int) -> Array:
        """Return central differences of W by one or two logarithmic strains, (n,). Collective."""
        # No chain reaches L.
        equilibrium = self.stepper.coupling.equilibrium
        room = 1 - max(0.0, equilibrium.limits().max_chain_extension)
        h, total = STRAINS[len(axes)] * room, np.zeros(len(self._places))
        for signs in itertools.product((1.0, -1.0), repeat=len(axes)):
            strains = np.zeros(3)
            np.add.at(strains, list(axes), np.multiply(signs, h))
            total += np.prod(signs) * self._energy(strains)
        return np.asarray(total / (2 * h) ** len(axes))

    def _energy(self, strains: Array) -> Array:
        """Return W at the points after further stretches exp(strains) along the axes, (n,)."""
        Q, tissue = self._directions, self.state.parameters(self.stepper.tissue).at_points()
        stretch = (Q * np.exp(strains)) @ Q.swapaxes(1, 2)
        return tissue.strain_energy(
            stretch @ self.state.elastic_gradient(), [self.state.cells.point_cells]
        )
