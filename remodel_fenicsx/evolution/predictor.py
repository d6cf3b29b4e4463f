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


class Remembering:
    """Makes the next increment of the last ones, while loads go on at the same rates."""

    def __init__(self, state: State, increment: str, numbers: str, count: int):
        self.state, self._count = state, count
        self._increments = Earlier(state, increment, state.unknown.copy, count)
        rates = {f"rate_{name}": 0.0 for name in state.loading.values}
        durations = {f"duration_{age}": 0.0 for age in range(count)}  # of the increments, the newest first
        self._numbers = Numbers(state, numbers, {"time": 0.0} | durations | rates)

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns plus the next increment, with the values that supports and loads prescribe."""
        if not self._increments.known or not self._goes_on(step):
            return None
        values: Array = self.state.unknown.x.array + self._increment(step)
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def solved(self, step: LoadStep, before: Array) -> None:
        """Remember the increment."""
        numbers, again = self._numbers, self._numbers["time"] == step.time  # solved once more: a coupling that iterates
        goes_on = again or self._goes_on(step)
        for earlier, value in self._found(before):
            if again:
                earlier.values[0][:] += value
                continue
            if not goes_on:
                earlier.forget()
            earlier.push(value)
        if not again:
            for age in reversed(range(1, self._count)):
                numbers[f"duration_{age}"] = numbers[f"duration_{age - 1}"]
            numbers["duration_0"], numbers["time"] = step.duration, step.time
            for name, rate in step.rates.items():
                numbers[f"rate_{name}"] = rate

    def _increment(self, step: LoadStep) -> Array:
        raise NotImplementedError

    def _found(self, before: Array) -> list[tuple[Earlier, Array]]:
        """What is remembered of a step, and where."""
        return [(self._increments, self.state.unknown.x.array - before)]

    def _goes_on(self, step: LoadStep) -> bool:
        """Whether the rates are those of the last step."""
        return all(_same(rate, self._numbers[f"rate_{name}"]) for name, rate in step.rates.items())


class Autoregressive(Remembering):
    """The next increment as a combination of the last three: d_n = sum_j a_j d_(n-j)."""

    def __init__(self, state: State):
        super().__init__(state, "predictor_increment", "predictor", ORDER + FITTED)

    def _increment(self, step: LoadStep) -> Array:
        increments = self._as_of(step.duration)
        if len(increments) < ORDER + FITTED:
            return increments[0]
        return np.asarray(np.tensordot(self._weights(increments), np.array(increments[:ORDER]), axes=1))

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


class Responsive(Remembering):
    """The next increment as that combination of the last ones that makes up what the step asks for."""

    def __init__(self, state: State):
        super().__init__(state, "responsive_increment", "responsive", ANSWERS)
        self.quadrature, components = state.cells.quadrature, (len(tensors.MANDEL),)
        self._changes = Earlier(state, "responsive_change", lambda: self.quadrature.function("", components), ANSWERS)
        shares = self.quadrature.owned(self.quadrature.volumes).ravel()
        self._roots = np.repeat(np.sqrt(shares), *components)  # of the points' volumes
        self._asked: Array | None = None  # the change of the step under way

    def expected(self, step: LoadStep) -> Array | None:
        self._asked = None
        return super().expected(step)

    def _increment(self, step: LoadStep) -> Array:
        self._asked = self._change()
        return np.asarray(self._weights(step, self._asked) @ np.array(self._increments.values))

    def _found(self, before: Array) -> list[tuple[Earlier, Array]]:
        change, self._asked = self._change() if self._asked is None else self._asked, None
        return [*super()._found(before), (self._changes, change)]

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


def _same(one: float, other: float) -> bool:
    return abs(one - other) <= SAME_RATE * max(abs(one), abs(other))


PREDICTORS: dict[str, Callable[[State], Predictor]] = {
    "none": NoPredictor,
    "with-tolerance": NoPredictor,
    "autoregressive": Autoregressive,
    "responsive": Responsive,
}
"""By the name that `solver.predictor` has; a tolerance makes the last of any but "none" (`Simulation`)."""
