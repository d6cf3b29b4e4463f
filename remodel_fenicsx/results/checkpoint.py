"""Checkpoints of a state: a watcher writes them; any number of ranks restores them."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.checkpoint_file import (
    Array,
    Checkpoint,
    CheckpointError,
    write_checkpoint,
)
from remodel_fenicsx.fem.assembly import raise_on_all_ranks
from remodel_fenicsx.state import State
from remodel_fenicsx.system.environment import versions

log = logging.getLogger(__name__)
T = TypeVar("T")

MAX_LOSS_SECONDS = 600.0  # seconds
# seconds between two checkpoints that are chosen by time: a shorter pause saves too little work
SHORTEST_PAUSE = 10.0
MAX_TIME_FRACTION = 0.04  # of the time of a run, for checkpoints that are chosen by time


class Checkpoints(Watcher):
    """A watcher that writes checkpoints of the state at intervals, and of the last step."""

    def __init__(
        self,
        folder: Path,
        state: State,
        scene_text: str,
        every: int | None,
        before: Sequence[Callable[[], None]],
    ):
        self.before = before
        self.folder, self.state = folder, state
        self.scene_text, self.every = scene_text, every
        self._mesh = mesh_arrays(state.loading.domain)
        self._versions = versions() if state.comm.rank == 0 else {}
        self._written_at, self._cost = clock.monotonic(), 0.0
        self._number = 0  # of the newest checkpoint; without one the run starts again at t = 0

    # ------------------------------------------------------------ as a watcher
    def resumed(self, step: Step) -> None:
        """Note the number of the checkpoint that the state comes from."""
        self._number = step.number

    def committed(self, step: Step) -> None:
        """Write a checkpoint, if one is due."""
        if step.is_last or self._is_due(step.number):
            self.write()

    def _is_due(self, number: int) -> bool:
        """Return whether a checkpoint is due, the same on all ranks. Collective."""
        if self.every is not None:
            return self.every > 0 and number % self.every == 0
        pause = min(max(SHORTEST_PAUSE, self._cost / MAX_TIME_FRACTION), MAX_LOSS_SECONDS)
        due = clock.monotonic() - self._written_at >= pause
        return bool(self.state.comm.bcast(due, root=0))

    # ------------------------------------------------------------ writing
    def write(self) -> None:
        """Write the state, unless the newest checkpoint is of this step. Collective."""
        if self.state.number == self._number:
            return
        start = clock.monotonic()
        for keep in self.before:
            keep()
        state, arrays = self.state, gather_state(self.state)
        if arrays is not None and self._mesh is not None:
            checkpoint = Checkpoint(
                time=state.time,
                number=state.number,
                scene=self.scene_text,
                versions=self._versions,
                loads=marked(state, lambda case: case.loading.values),
                numbers=marked(state, lambda case: case.numbers),
                functions=list(arrays),
                arrays={f"function/{name}": values for name, values in arrays.items()} | self._mesh,
            )
            write_checkpoint(self.folder, checkpoint)
        self._number, self._written_at = state.number, clock.monotonic()
        self._cost = self._written_at - start


def mesh_arrays(domain: Domain) -> dict[str, Array] | None:
    """Return the mesh in the input's numbering, on rank 0. Collective."""
    points, elements = domain.gather_mesh()
    return None if points is None or elements is None else {"points": points, "elements": elements}


def gather_state(state: State) -> dict[str, Array] | None:
    """Return every function of a state by name, on rank 0. Collective.

    Each array is (elements, values of one element), in the order of the input.
    """
    domain, functions = state.loading.domain, state.functions()
    gathered = {
        name: domain.gather_elements(one.x.array[_places(one)]) for name, one in functions.items()
    }
    return gathered if domain.comm.rank == 0 else None  # type: ignore[return-value]


def restore_state(state: State, checkpoint: Checkpoint | None) -> None:
    """Restore a state from a checkpoint. Collective."""
    domain, comm = state.loading.domain, state.comm
    mesh, first = mesh_arrays(domain), comm.rank == 0
    raise_on_all_ranks(
        comm,
        lambda: _check(state, domain, cast(Checkpoint, checkpoint), mesh or {}) if first else None,
    )
    header = comm.bcast(
        checkpoint.model_copy(update={"arrays": {}}) if first and checkpoint else None
    )
    missing, counts = [name for name in state.functions() if name not in header.functions], _counts(
        state
    )
    for name, function in state.functions().items():
        if name not in missing:
            values = checkpoint.arrays[f"function/{name}"] if first and checkpoint else None
            function.x.array[_places(function)] = domain.scatter_elements(values)
    state.complete_step(header.time, header.number)
    numbers = header.numbers | {counts[name]: 0.0 for name in missing}
    if missing and first:
        log.info("not in the checkpoint, so they begin anew: %s", ", ".join(missing))
    for mark, case in state.each_case().items():
        case.numbers |= values_of_case(numbers, mark)
        kept = values_of_case(header.loads, mark)
        case.loading.set({name: kept.get(name, 0.0) for name in case.loading.values})


def _check(state: State, domain: Domain, checkpoint: Checkpoint, mesh: dict[str, Array]) -> None:
    """Raise CheckpointError unless the checkpoint is one of this state."""
    arrays, counts = checkpoint.arrays, _counts(state)
    wanted = {
        n: (domain.number_of_elements, _places(one).shape[1])
        for n, one in state.functions().items()
    }
    begins_anew = {name: shape for name, shape in wanted.items() if name in counts}
    stored = {name: arrays[f"function/{name}"].shape for name in checkpoint.functions}
    own = marked(state, lambda case: case.loading.values)
    # earlier versions stored all loads, zero or not
    loads = {name for name, value in checkpoint.loads.items() if value}
    if not wanted.items() <= (begins_anew | stored).items() or not loads <= own.keys():
        there, here = (
            f"functions {a} and loads {sorted(b)}" for a, b in ((stored, loads), (wanted, own))
        )
        raise CheckpointError(f"the checkpoint has the {there}; this run has the {here}")
    points, elements = arrays["points"], arrays["elements"]
    same = points.shape == mesh["points"].shape and np.array_equal(elements, mesh["elements"])
    if not same or not np.allclose(points, mesh["points"], rtol=0.0, atol=1e-9 * domain.size):
        raise CheckpointError(
            "the checkpoint has another mesh; perhaps Gmsh has another version now (run.log names "
            "that of the run)"
        )


def marked(state: State, values: Callable[[State], Mapping[str, T]]) -> dict[str, T]:
    """Return values by name of all load cases in one, each name with the mark of its case."""
    cases = state.each_case().items()
    return {f"{name}{mark}": value for mark, case in cases for name, value in values(case).items()}


def values_of_case(values: Mapping[str, T], mark: str) -> dict[str, T]:
    """Return the values of one load case, by their names without its mark."""
    parts = {name: name.partition("@") for name in values}
    return {
        parts[name][0]: value for name, value in values.items() if "".join(parts[name][1:]) == mark
    }


def _counts(state: State) -> dict[str, str]:
    """`State.counts` of all load cases."""
    cases = state.each_case().items()
    return {
        f"{name}{mark}": f"{count}{mark}"
        for mark, case in cases
        for name, count in case.counts.items()
    }


def _places(function: object) -> Array:
    """Return indices into the function's array, (elements, values of one element)."""
    space = function.function_space  # type: ignore[attr-defined]
    dofs, size = np.asarray(space.dofmap.list, dtype=np.int64), space.dofmap.bs
    # not -1: a rank may have no element at all
    return (dofs[..., None] * size + np.arange(size)).reshape(len(dofs), dofs.shape[1] * size)
