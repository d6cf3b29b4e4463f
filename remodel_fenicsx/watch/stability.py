"""Watches whether equilibria are stable: cheap signs from Newton's factorisations decide when to count."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.diagnosis import FactorisationFailed, Inertia, Mode, UNSTABLE, of_the_unloaded_body
from remodel_fenicsx.solver.linear import negative_pivots, uneven
from remodel_fenicsx.state.state import Earlier, Numbers

log = logging.getLogger(__name__)

ITERATIONS_BETWEEN_LOOKS = 100  # Newton iterations with a tangent, each of about the cost of a look
OLD_FACTOR = 1 / 8  # of these, what an iteration without a new tangent counts
MOST_UNKNOWNS = 200_000  # of a look that nobody has asked for: factors of more take minutes and gigabytes
FIRST_INVERSE_ITERATIONS = 3  # later steps go on from the vector of the step before: one each


class EquilibriumStability(Watcher):
    """Knows the number of negative eigenvalues of the tangent at solved states, and says when it changes."""

    def __init__(self, stepper: Stepper, unstable: str = "warn", every_step: bool = False):
        self.stepper, self.state = stepper, stepper.state
        self.stops, self.every_step = unstable == "stop", every_step or unstable == "stop"
        self.inertia = Inertia(stepper.coupling.equilibrium)
        self.signs = Signs(stepper)
        self.unknowns = int(self.state.comm.allreduce(self.state.number_of_owned_unknowns))
        # eigenvalues that are known, and Newton iterations since the last look
        self._numbers = Numbers(self.state, "stability", {"known": 0, "iterations": 0})
        self._unloaded: tuple[int, float] | None = None

    def close(self) -> None:
        """Free PETSc's objects."""
        self.inertia.close()

    # ------------------------------------------------------------ as a watcher
    def started(self, step: Step) -> None:
        """Count at the start, where it is a row that somebody wants."""
        if self.every_step:
            step.negative_eigenvalues = self._count()

    def solved(self, step: Step) -> None:
        """Count, if it is time."""
        known = int(self._numbers["known"])
        work = step.work
        effort = work.tangents + OLD_FACTOR * max(0, work.newton_iterations - work.tangents)
        self._numbers["iterations"] = iterations = self._numbers["iterations"] + effort
        suspicious = self.signs.differ(known) if step.work.newton_iterations else False
        overdue = iterations >= ITERATIONS_BETWEEN_LOOKS or (step.is_last and iterations > 0)
        if overdue and not suspicious and not self.every_step and self.unknowns > MOST_UNKNOWNS:
            overdue = False
            if step.is_last:
                self._info(
                    "the stability of equilibria was not checked: with %d unknowns that is done only on request, by "
                    "the column negative_eigenvalues or solver.unstable = 'stop'", self.unknowns,
                )  # fmt: skip
        if not (suspicious or overdue or self.every_step):
            return
        step.negative_eigenvalues = count = self._count()
        if np.isnan(count):
            return
        self._numbers["iterations"] = 0
        self.signs.settle()
        if count != known:
            self._numbers["known"] = count
            self._say(step, known, int(count))

    # ------------------------------------------------------------ what it means
    def _count(self) -> float:
        try:
            return self.inertia.negative_eigenvalues()
        except FactorisationFailed as failure:
            self._warn("the stability of the equilibrium is not known: %s", failure)
            return float("nan")

    def _say(self, step: Step, before: int, now: int) -> None:
        if now < before:
            self._info("%s: %s of the tangent, %d before", step.moment, eigenvalues(now), before)
            return
        unloaded, scale = self._of_the_unloaded_body()
        if now <= unloaded:
            self._info(
                "%s: %s of the tangent. The unloaded body has %d, from the stress of its cells at the start: the "
                "equilibrium is not lost", step.moment, eigenvalues(now), unloaded,
            )  # fmt: skip
            return
        text = f"{eigenvalues(now)} of the tangent ({before} before); {described(self.inertia.lowest(), scale)}"
        if self.stops:
            raise StepFailure(step.time, f"the equilibrium at {step.moment} is unstable: {text}", UNSTABLE)
        self._warn("%s: the equilibrium is unstable, and the body would leave it: %s", step.moment, text)

    def _of_the_unloaded_body(self) -> tuple[int, float]:
        """`inertia.of_the_unloaded_body`, once."""
        if self._unloaded is None:
            self._unloaded = of_the_unloaded_body(self.inertia)
        return self._unloaded

    def _warn(self, *message: Any) -> None:
        if self.state.comm.rank == 0:
            log.warning(*message)

    def _info(self, *message: Any) -> None:
        if self.state.comm.rank == 0:
            log.info(*message)


class Signs:
    """What the factors of Newton's last tangent tell for nothing, or for one substitution, about its eigenvalues."""

    def __init__(self, stepper: Stepper):
        self.newton, self.equilibrium = stepper.coupling.newton, stepper.coupling.equilibrium
        state = stepper.state
        self._vector = Earlier(state, "stability_vector", state.unknown.copy, 1)
        self._pivots = Numbers(state, "stability_pivots", {"now": 0, "at_look": 0})  # negative ones

    def differ(self, known: int) -> bool:
        """Whether they contradict what is known: a number of negative eigenvalues."""
        factorisation = self.newton.factorisation()
        if factorisation is None:
            return False
        before, found = int(self._pivots["at_look"]), negative_pivots(factorisation)
        now = before if found is None else found
        self._pivots["now"] = now
        differs = now % 2 != before % 2 or (now == 0) != (before == 0)
        return differs or (self._curvature(factorisation) < 0 and known == 0)

    def settle(self) -> None:
        """The eigenvalues have been counted: from now on what differs from the present signs is news."""
        self._pivots["at_look"] = self._pivots["now"]

    def _curvature(self, factorisation: Any) -> float:
        """Of the remembered vector after one more inverse iteration."""
        vector, image = factorisation.getOperators()[0].createVecs()
        first = not self._vector.known
        if first:
            uneven(vector)
            free = np.isnan(self.equilibrium.prescribed_values()[: vector.getLocalSize()])
            vector.array[:] *= free  # prescribed ones have an eigenvalue of their own, one
        else:
            vector.array[:] = self._vector.values[0][: vector.getLocalSize()]
        curvature = np.inf
        for _ in range(FIRST_INVERSE_ITERATIONS if first else 1):
            factorisation.apply(vector, image)
            size = image.norm()
            if size == 0.0:  # supports and loads leave nothing free
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
    """In words."""
    return f"{number or 'no'} negative eigenvalue{'' if number == 1 else 's'}"


def described(mode: Mode, unloaded: float) -> str:
    """A mode in words; `unloaded`: the lowest eigenvalue of the unloaded body, which is the unit where positive."""
    place = ", ".join(f"{c:.4g}" for c in mode.place)
    size = f"{mode.eigenvalue / unloaded:.3g} times its unloaded value" if unloaded > 0 else f"{mode.eigenvalue:.3g}"
    return f"the lowest is {size}, and its mode is largest at ({place})"
