"""A step is all or nothing, whoever fails in it; simulations of one process do not know of each other."""

from __future__ import annotations

import errno
import re
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx import Recording, Scene, SceneError, Simulation
from remodel_fenicsx.body.shape import Column
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.fields import Fields
from remodel_fenicsx.results.run_folder import RunFolder
from tests.parts import pulled_cube
from tests.runs import made

END, FAILS = 5, 3.0
WITHOUT_LIMIT = resource.getrlimit(resource.RLIMIT_FSIZE)


def scene(**solver: Any) -> Scene:
    """The pulled cube to the end of these tests."""
    return pulled_cube(float(END), solver=solver)


def everything(simulation: Simulation) -> dict[str, Any]:
    """Copies of all that a step changes, the magnitudes in the forms too."""
    state, unknown = simulation.state, simulation.unknown
    loads = simulation.loading.external_residual(ufl.TestFunction(unknown.function_space))
    solved = state.equilibrium_cells
    return {
        "u": unknown.x.array.copy(),
        "l": simulation.cells.dimension_values.copy(),
        "n": simulation.cells.axis_values.copy(),
        "solved l": solved.dimension_values.copy(),
        "solved n": solved.axis_values.copy(),
        "loads": list(simulation.loading.values.values()),
        "magnitudes": [float(constant.value) for constant in loads.constants()],
        "extension": simulation.stepper.coupling.equilibrium.limits().max_chain_extension,
        "time": state.time,
        "number": state.number,
    }


def assert_same(found: dict[str, Any], expected: dict[str, Any]) -> None:
    """To the last bit."""
    assert list(found) == list(expected)
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def numbers(step: Step) -> dict[str, float]:
    """A row without the wall time."""
    return {name: value for name, value in step.row.items() if name != "seconds"}


@pytest.fixture(scope="module")
def undisturbed() -> tuple[list[dict[str, float]], dict[str, Any]]:
    """All rows, and everything at the end."""
    with made(scene()) as simulation:
        rows = [numbers(step) for step in simulation.steps()]
        last = everything(simulation)
    return rows, last


# ---------------------------------------------------------------- who may fail
class Once:
    """Raises when it is called with a time for the first time."""

    def __init__(self, error: BaseException):
        self.error, self.left = error, 1

    def __call__(self, time: float) -> float:
        if time == FAILS and self.left:
            self.left = 0
            raise self.error
        return 0.0


class Spoiler(Watcher):
    """Fails at one hook."""

    def __init__(self, hook: str, error: BaseException):
        once = Once(error)
        setattr(self, hook, lambda step: once(step.time))


class FullDisk(Watcher):
    """A limit on the size of files stands for the full disk: 5 bytes more for the history, at one step."""

    def __init__(self, history: Path):
        self.history, self.left = history, 1

    def completed(self, step: Step) -> None:
        if step.time == FAILS and self.left:
            self.left = 0
            resource.setrlimit(
                resource.RLIMIT_FSIZE, (self.history.stat().st_size + 5, WITHOUT_LIMIT[1])
            )


def column(after_pass: bool) -> Callable[..., list[Watcher]]:
    """A column of the solved state, or one of the whole step."""

    def prepare(
        simulation: Simulation, error: BaseException, patch: pytest.MonkeyPatch, folder: Path
    ) -> list[Watcher]:
        once = Once(error)
        simulation.observer.columns += (
            Column("odd", "", "fails once", lambda m: once(m.step.time), after_pass),
        )
        return []

    return prepare


def hook(name: str) -> Callable[..., list[Watcher]]:
    """A watcher of a user's."""
    return lambda simulation, error, patch, folder: [Spoiler(name, error)]


def after(
    where: Callable[[Simulation], Any], method: str, time: Callable[..., float]
) -> Callable[..., list[Watcher]]:
    """A method of a part that has done its work when it fails."""

    def prepare(
        simulation: Simulation, error: BaseException, patch: pytest.MonkeyPatch, folder: Path
    ) -> list[Watcher]:
        once, part = Once(error), where(simulation)
        real = getattr(part, method)

        def failing(*arguments: Any, **options: Any) -> Any:
            answer = real(*arguments, **options)
            once(time(*arguments))
            return answer

        patch.setattr(part, method, failing)
        return []

    return prepare


def full_disk(
    simulation: Simulation, error: BaseException, patch: pytest.MonkeyPatch, folder: Path
) -> list[Watcher]:
    """The history's."""
    return [FullDisk(folder / "history.csv")]


FAULTS: dict[str, tuple[Callable[..., list[Watcher]], BaseException]] = {
    "loads": (after(lambda s: s.stepper, "load_values", lambda time: time), KeyError("force")),
    "solver": (
        after(lambda s: s.stepper.coupling, "solve", lambda time, loads: time),
        KeyboardInterrupt(),
    ),
    "column": (column(after_pass=False), ZeroDivisionError()),
    "watcher, solved": (hook("solved"), RuntimeError()),
    "pass": (
        after(lambda s: s.stepper.remodeling, "apply", lambda old, new, *_: new),
        FloatingPointError(),
    ),
    "column after the pass": (column(after_pass=True), ValueError()),
    "watcher, completed": (hook("completed"), KeyboardInterrupt()),
    "history": (full_disk, OSError(errno.EFBIG, "File too large")),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_who_fails_in_a_step_undoes_it(
    fault: str, undisturbed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state is that of the step before, and the same step again is that of a run without the fault."""
    prepare, error = FAULTS[fault]
    simulation, expected = Simulation(scene(), MPI.COMM_SELF), undisturbed
    with RunFolder(tmp_path / "run", scene().to_toml()) as record, monkeypatch.context() as patch:
        folder = record.folder
        with Fields(folder, simulation.scene.geometry, simulation.stepper) as fields:
            # what a step has left in the files goes too, so the one that fails comes after them, a full disk before
            failing = prepare(simulation, error, patch, folder)
            files = [fields, *failing, record] if fault == "history" else [fields, record, *failing]
            watchers = [simulation.observer, *files]
            simulation.stepper.start(watchers)
            done = [simulation.stepper.advance(time, watchers) for time in (1.0, 2.0)]
            before = everything(simulation)
            try:
                with pytest.raises(type(error)) as caught:
                    simulation.stepper.advance(FAILS, watchers)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, WITHOUT_LIMIT)
            assert_same(everything(simulation), before)
            assert (
                before["time"] == 2.0 and before["number"] == 2 and str(caught.value) == str(error)
            )
            done += [
                simulation.stepper.advance(float(time), watchers) for time in range(3, END + 1)
            ]
    rows = [
        {name: value for name, value in numbers(step).items() if name != "odd"} for step in done
    ]
    assert rows == expected[0]
    assert_same(everything(simulation), expected[1])
    recording = Recording(folder)
    assert (
        recording.history["time"].tolist()
        == recording.times.tolist()
        == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    )
    stretched = 1 + recording.fields(FAILS)["displacement"][:, 2].max()
    assert stretched > recording.value("mean_stretch", FAILS) > 1.05
    simulation.close()


def test_who_fails_before_the_first_step_leaves_the_start(undisturbed: Any) -> None:
    class Refuses(Watcher):
        def started(self, step: Step) -> None:
            raise RuntimeError(f"not at {step.time}")

    with made(scene()) as simulation:
        before = everything(simulation)
        with pytest.raises(RuntimeError, match="not at 0.0"):
            next(simulation.steps([Refuses()]))
        assert_same(everything(simulation), before)
        assert [numbers(step) for step in simulation.steps()] == undisturbed[0]


def test_who_fails_after_a_step_was_accepted_leaves_it_accepted(undisturbed: Any) -> None:
    with made(scene()) as simulation:
        watchers = [simulation.observer, Spoiler("committed", RuntimeError("too late"))]
        with pytest.raises(RuntimeError, match="too late"):
            list(simulation.stepper.march([1.0, 2.0, 3.0, 4.0], watchers))
        assert simulation.state.time == FAILS and simulation.state.number == 3
        with pytest.raises(ValueError, match="does not come after"):
            simulation.stepper.advance(FAILS, watchers)
        rows = [numbers(simulation.stepper.advance(time, watchers)) for time in (4.0, 5.0)]
        assert rows == undisturbed[0][3:]
        assert_same(everything(simulation), undisturbed[1])


# ---------------------------------------------------------------- two simulations in one process
KRYLOV = {
    "ksp_type": "gmres",
    "pc_type": "jacobi",
    "ksp_rtol": 1e-12,
    "pc_factor_mat_solver_type": False,
}


def own_options() -> set[str]:
    """What problems have in PETSc's database."""
    return {name for name in PETSc.Options().getAll() if re.match(r"remodel_\d+_", name)}


def test_two_simulations_have_their_own_solvers(undisturbed: Any) -> None:
    """A direct and a Krylov solver, step by step in turns; closing one leaves the other, and nothing stays behind."""
    others = own_options()
    direct, krylov = (
        Simulation(scene(petsc_options=options), MPI.COMM_SELF) for options in ({}, KRYLOV)
    )
    one, other = direct.steps(), krylov.steps()
    rows: dict[str, list[dict[str, float]]] = {"direct": [], "krylov": []}
    for number in range(END):
        rows["direct"].append(numbers(next(one)))
        if number == 2:
            assert len({name.split("_")[1] for name in own_options() - others}) >= 2
            krylov.close()
        if number < 2:
            rows["krylov"].append(numbers(next(other)))
    assert rows["direct"] == undisturbed[0]
    for found, expected in zip(rows["krylov"], rows["direct"]):
        assert found["mean_stretch"] == pytest.approx(expected["mean_stretch"], rel=1e-9)
        assert expected["linear_iterations"] == expected["newton_iterations"]
        assert found["linear_iterations"] > 5 * found["newton_iterations"]
    direct.close()
    direct.close()
    assert own_options() == others


def test_options_that_petsc_refuses_leave_nothing_behind() -> None:
    others = own_options()
    with pytest.raises(SceneError, match="^solver.petsc_options: ksp_type = 'none_of_them'"):
        Simulation(scene(petsc_options={"ksp_type": "none_of_them"}), MPI.COMM_SELF)
    assert own_options() == others
