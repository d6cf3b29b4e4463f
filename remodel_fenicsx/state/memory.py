"""What somebody remembers of earlier steps: functions and numbers of the state, so that resumed runs have them too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.state.state import State

Array = NDArray[np.float64]


class Numbers:
    """Numbers of the state under a name of their own: transactions restore them, checkpoints hold them.

    Parameters
    ----------
    state
        Whose `numbers` they are.
    name
        What all their keys begin with.
    initial
        Names of the numbers, and what they are at the start.
    """

    def __init__(self, state: State, name: str, initial: Mapping[str, float]):
        self.state, self.name, self.initial = state, name, dict(initial)
        self._keys = {key: f"{name}_{key}" for key in self.initial}  # steps ask often

    def __getitem__(self, key: str) -> float:
        return self.state.numbers.get(self._keys[key], self.initial[key])

    def __setitem__(self, key: str, value: float) -> None:
        """The same value on all ranks."""
        self.state.numbers[self._keys[key]] = float(value)

    def forget(self) -> None:
        """As at the start."""
        for key, value in self.initial.items():
            self[key] = value


class Occasions:
    """When it is time to look again at what changes with the loads, and slowly without.

    Parameters
    ----------
    state
        Whose loads they are.
    name
        Of whoever looks.
    """

    STEPS = 10  # of unchanged loads, after which one looks all the same: cells remodel

    def __init__(self, state: State, name: str):
        self.state = state
        self._loads = Numbers(state, f"{name}_loads", dict.fromkeys(state.loading.values, 0.0))
        self._steps = Numbers(state, f"{name}_steps", {"since": self.STEPS})

    def due(self) -> bool:
        """Whether it is, asked once in each step."""
        loads = self.state.loading.values
        changed = [name for name, value in loads.items() if self._loads[name] != value]
        for name in changed:
            self._loads[name] = loads[name]
        self._steps["since"] += 1
        due = bool(changed) or self._steps["since"] >= self.STEPS
        if due:
            self._steps["since"] = 0
        return due


class Earlier:
    """The last values of a field, as functions of the state.

    Parameters
    ----------
    state
        Which has them from now on.
    name
        What the names of the functions begin with.
    make
        Makes a dolfinx function.
    count
        How many values are kept.
    """

    def __init__(self, state: State, name: str, make: Callable[[], Any], count: int):
        self._functions = []
        for age in range(count):
            function = make()
            function.name = f"{name}_{age}"
            state.remember(function, f"{name}_known")
            self._functions.append(function)
        self._arrays: list[Array] = [function.x.array for function in self._functions]
        self._numbers = Numbers(state, name, {"known": 0})

    @property
    def known(self) -> int:
        """How many values there are."""
        return int(self._numbers["known"])

    @property
    def values(self) -> list[Array]:
        """The newest first, the functions' own memory, ghosts included."""
        return self._arrays[: self.known]

    def push(self, values: Array) -> None:
        """One value more, for owned unknowns and ghosts; the oldest goes."""
        for age in range(len(self._arrays) - 1, 0, -1):
            self._arrays[age][:] = self._arrays[age - 1]
        self._arrays[0][:] = values
        self._numbers["known"] = min(self.known + 1, len(self._arrays))

    def push_owned(self, values: Array) -> None:
        """The same without ghosts; collective."""
        whole = np.zeros_like(self._arrays[0])
        whole[: len(values)] = values
        self.push(whole)
        self._functions[0].x.scatter_forward()

    def forget(self) -> None:
        """There have been none."""
        self._numbers.forget()
