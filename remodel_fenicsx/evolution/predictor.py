"""Where Newton's method starts a step: the unknowns of the step before, or what the last steps let expect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model import tensors
from remodel_fenicsx.state.state import Earlier, Numbers, State

Array = NDArray[np.float64]

ANSWERS = 5  # increments of which `Responsive` combines the next one
ORDER, FITTED = 3, 2  # increments that predict the next one; increments to which the weights are fitted
SAME_RATE = 1e-9  # relative difference of two rates of a load, and of two steps in time, that are the same
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
    """The next increment as a combination of the last three: d_n = sum_j a_j d_(n-j)."""

    def __init__(self, state: State):
        self.state = state
        self._increments = Earlier(state, "predictor_increment", state.unknown.copy, ORDER + FITTED)
        rates = {f"rate_{name}": 0.0 for name in state.loading.values}
        durations = {f"duration_{age}": 0.0 for age in range(ORDER + FITTED)}  # of the increments, the newest first
        self._numbers = Numbers(state, "predictor", {"time": 0.0} | durations | rates)

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns plus the next increment, with the values that supports and loads prescribe."""
        if not self._increments.known or not _goes_on(step, self._numbers):
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
        if not _goes_on(step, self._numbers):
            self._increments.forget()
        self._increments.push(increment)
        _remember(step, self._numbers, ORDER + FITTED)

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


class Responsive:
    """The next increment as that combination of the last ones that makes up what the step asks for."""

    def __init__(self, state: State):
        self.state, self.quadrature = state, state.cells.quadrature
        self._increments = Earlier(state, "responsive_increment", state.unknown.copy, ANSWERS)
        components = (len(tensors.MANDEL),)
        self._changes = Earlier(state, "responsive_change", lambda: self.quadrature.function("", components), ANSWERS)
        rates = {f"rate_{name}": 0.0 for name in state.loading.values}
        durations = {f"duration_{age}": 0.0 for age in range(ANSWERS)}  # the newest first
        self._numbers = Numbers(state, "responsive", {"time": 0.0} | durations | rates)
        shares = self.quadrature.owned(self.quadrature.volumes).ravel()
        self._roots = np.repeat(np.sqrt(shares), *components)  # of the points' volumes
        self._asked: Array | None = None  # the change of the step under way

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns plus the next increment, with the values that supports and loads prescribe."""
        self._asked = None
        if not self._increments.known or not _goes_on(step, self._numbers):
            return None
        self._asked = self._change()
        increment = self._weights(step, self._asked) @ np.array(self._increments.values)
        values: Array = self.state.unknown.x.array + increment
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def solved(self, step: LoadStep, before: Array) -> None:
        """Remember the increment and what it answers."""
        increment = self.state.unknown.x.array - before
        change, self._asked = self._change() if self._asked is None else self._asked, None
        if self._numbers["time"] == step.time:  # solved once more: a coupling that iterates
            self._increments.values[0][:] += increment
            self._changes.values[0][:] += change
            return
        if not _goes_on(step, self._numbers):
            self._increments.forget()
            self._changes.forget()
        self._increments.push(increment)
        self._changes.push(change)
        _remember(step, self._numbers, ANSWERS)

    def _change(self) -> Array:
        """Of the structure tensors since the last solved state, Mandel components after each other."""
        state = self.state
        change = state.cells.structure_tensor() - state.equilibrium_cells.structure_tensor()
        return tensors.to_mandel(change.reshape(-1, 3, 3)).ravel()

    def _weights(self, step: LoadStep, asked: Array) -> Array:
        """Of the last increments, the newest first."""
        changes = np.array([asked, *self._changes.values])[:, : len(self._roots)] * self._roots
        products = over_ranks(self.state.comm, changes @ changes.T, MPI.SUM)
        known = len(products) - 1
        if any(step.rates.values()):  # loads change with time; the last change counts as much as that of the cells
            durations = [self._numbers[f"duration_{age}"] for age in range(known)]
            lengths = np.array([step.duration, *durations]) / durations[0]
            products += (products[1, 1] or products.diagonal().max() or 1.0) * np.outer(lengths, lengths)
        matrix, right = products[1:, 1:], products[1:, 0]
        least = INDEPENDENT * float(matrix.diagonal().sum())
        if not least:  # nothing has changed
            return np.zeros(known)
        matrix.flat[:: known + 1] += least
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def _goes_on(step: LoadStep, known: Numbers) -> bool:
    """Whether the rates are those of the last step."""
    return all(_same(rate, known[f"rate_{name}"]) for name, rate in step.rates.items())


def _remember(step: LoadStep, known: Numbers, count: int) -> None:
    """The step's time, rates and length, with the lengths of those before."""
    for age in reversed(range(1, count)):
        known[f"duration_{age}"] = known[f"duration_{age - 1}"]
    known["time"], known["duration_0"] = step.time, step.duration
    for name, rate in step.rates.items():
        known[f"rate_{name}"] = rate


def _same(first: float, second: float) -> bool:
    return abs(first - second) <= SAME_RATE * max(abs(first), abs(second))


PREDICTORS: dict[str, Callable[[State], Predictor]] = {
    "none": NoPredictor,
    "with-tolerance": NoPredictor,
    "autoregressive": Autoregressive,
    "responsive": Responsive,
}
"""By the name that `solver.predictor` has; a tolerance makes the last of any but "none" (`Simulation`)."""
