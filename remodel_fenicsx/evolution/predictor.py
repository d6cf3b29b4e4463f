"""Where Newton's method starts a step: the unknowns of the step before, or what the last steps let expect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.memory import Earlier, Numbers
from remodel_fenicsx.evolution.state import State

Array = NDArray[np.float64]

ORDER, FITTED = 3, 2  # increments that predict the next one; increments to which the weights are fitted
SAME = 1e-9  # relative difference of two rates of a load, and of two steps in time, that are the same
INDEPENDENT = 1e-12  # of increments: what is less is rounding


class LoadStep(NamedTuple):
    """A step as it is asked for: its end, its length, and the rates of the loads over it."""

    time: float
    duration: float
    rates: dict[str, float]

    @classmethod
    def between(cls, start: float, old: Mapping[str, float], end: float, new: Mapping[str, float]) -> LoadStep:
        """From two times and the loads there."""
        return cls(end, end - start, {name: (new.get(name, old[name]) - old[name]) / (end - start) for name in old})


class Predictor(Protocol):
    """Expects the solution of the next step."""

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns of this rank, ghosts included; None where nothing is expected but those of the step before."""

    def solved(self, step: LoadStep, before: Array) -> None:
        """The state is the solution of the step; `before`: the unknowns of the step before."""


class NoPredictor:
    """Each step starts where the last one ended."""

    def __init__(self, state: State):
        pass

    def expected(self, step: LoadStep) -> Array | None:
        """Nothing else."""
        return None

    def solved(self, step: LoadStep, before: Array) -> None:
        """Nothing is remembered."""


class Autoregressive:
    """The next increment as a combination of the last three: d_n = sum_j a_j d_(n-j).

    The weights a are those with which the last two increments follow best from the three before each (least squares
    over all unknowns). So they know a trend, and the part of a staggered pass that alternates from step to step, which
    polynomials only make worse. With fewer increments the last one is expected again. Increments of steps of another
    length count as at their own speed over the next one. Where the rate of a load changes, what was is forgotten.

    Parameters
    ----------
    state
        The last increments are part of it from now on.
    """

    def __init__(self, state: State):
        self.state = state
        self._increments = Earlier(state, "predictor_increment", state.unknown.copy, ORDER + FITTED)
        rates = {f"rate_{name}": 0.0 for name in state.loading.values}
        durations = {f"duration_{age}": 0.0 for age in range(ORDER + FITTED)}  # of the increments, the newest first
        self._numbers = Numbers(state, "predictor", {"time": 0.0} | durations | rates)

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns plus the next increment, with the values that supports and loads prescribe."""
        if not self._increments.known or not self._goes_on(step):
            return None
        increments = self._as_of(step.duration)
        increment = increments[0]
        if len(increments) == ORDER + FITTED:
            weighted = np.tensordot(self._weights(increments), np.array(increments[:ORDER]), axes=1)
            increment = np.asarray(weighted, dtype=np.float64)
        values: Array = self.state.unknown.x.array + increment
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def solved(self, step: LoadStep, before: Array) -> None:
        """Remember the increment."""
        increment = self.state.unknown.x.array - before
        if self._numbers["time"] == step.time:  # solved once more: a coupling that iterates
            self._increments.values[0][:] += increment
            return
        if not self._goes_on(step):
            self._increments.forget()
        self._increments.push(increment)
        for age in reversed(range(1, ORDER + FITTED)):
            self._numbers[f"duration_{age}"] = self._numbers[f"duration_{age - 1}"]
        self._numbers["time"], self._numbers["duration_0"] = step.time, step.duration
        for name, rate in step.rates.items():
            self._numbers[f"rate_{name}"] = rate

    def _goes_on(self, step: LoadStep) -> bool:
        """Whether the rates are those of the last step."""
        return all(_same(rate, self._numbers[f"rate_{name}"]) for name, rate in step.rates.items())

    def _as_of(self, duration: float) -> list[Array]:
        """The increments as they would be over a step of that length, at their own speeds."""
        scaled = []
        for age, increment in enumerate(self._increments.values):
            own = self._numbers[f"duration_{age}"]
            scaled.append(increment if _same(own, duration) else (duration / own) * increment)
        return scaled

    def _weights(self, increments: list[Array]) -> Array:
        rows = np.array([increment[: self.state.number_of_owned_unknowns] for increment in increments])
        products = self.state.comm.allreduce(rows @ rows.T, MPI.SUM)
        matrix, right = np.zeros((ORDER, ORDER)), np.zeros(ORDER)
        for k in range(FITTED):
            matrix += products[k + 1 : k + 1 + ORDER, k + 1 : k + 1 + ORDER]
            right += products[k + 1 : k + 1 + ORDER, k]
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=INDEPENDENT)[0], dtype=np.float64)


def _same(first: float, second: float) -> bool:
    return abs(first - second) <= SAME * max(abs(first), abs(second))


PREDICTORS: dict[str, Callable[[State], Predictor]] = {"none": NoPredictor, "autoregressive": Autoregressive}
"""By the name that `solver.predictor` has."""
