"""A run that ended early goes on: the same rows, fields and cells as those of a run that nobody disturbed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time as clock
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, SceneError
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.results.checkpoint import Checkpoints, gather_state, restore_state
from remodel_fenicsx.results.checkpoint_file import Checkpoint, CheckpointError
from remodel_fenicsx.results.checkpoint_file import read_checkpoint, read_file, time_of_checkpoint
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.schema.settings import COUPLINGS, CouplingKind
from remodel_fenicsx.system.files import command_name
from remodel_fenicsx.results.recording import FolderTaken, RunLock, lock_holder
from remodel_fenicsx.results.status import status
from remodel_fenicsx.running import resume, run
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.state import State
from remodel_fenicsx.system.interrupts import Paused
from tests.conftest import mpirun
from tests.parts import pulled_cube
from tests.processes import ran
from tests.runs import made
from tests.tables import rows as table
from tests.values import assert_close

END = 9.0
COUNTED = ("newton_iterations", "linear_iterations", "substeps", "seconds")
LOST_AT = 6.0  # when tests/on_two_ranks.py loses one
SELF = MPI.COMM_SELF


def scene(end: float = END, **output: Any) -> Scene:
    """The pulled cube with fields in every second step, and without a page."""
    return pulled_cube(end, output={"every": 2, "report": False, **output})


def rows(folder: Path) -> list[list[str]]:
    """history.csv without the wall time, the head first."""
    table = [line.split(",") for line in (folder / "history.csv").read_text().splitlines()]
    seconds = table[0].index("seconds")
    return [row[:seconds] + row[seconds + 1 :] for row in table]


def assert_same(found: Path, expected: Path) -> None:
    """Rows to the last digit, and the fields of all times."""
    assert rows(found) == rows(expected)
    mine, others = Recording(found), Recording(expected)
    assert mine.scene.with_values({"output": others.scene.output}) == others.scene
    assert mine.times.tolist() == others.times.tolist()
    for time in others.times:
        again, once = mine.fields(time), others.fields(time)
        assert again.keys() == once.keys()
        for name, values in once.items():
            np.testing.assert_array_equal(again[name], values, err_msg=f"{name} at {time}")
    one, two = read_checkpoint(found), read_checkpoint(expected)
    assert one is not None and two is not None and one.number == two.number
    for name, values in two.arrays.items():
        np.testing.assert_array_equal(one.arrays[name], values, err_msg=name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that nobody disturbs."""
    return run(scene(), tmp_path_factory.mktemp("whole") / "run", SELF)


@pytest.fixture(scope="module")
def first_half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same to t = 6: both generations are there, 5 and 6."""
    folder = run(scene(6.0, checkpoint=1), tmp_path_factory.mktemp("half") / "run", SELF)
    assert [read_file(path).number for path in newest_first(folder)] == [6, 5]
    return folder


@pytest.fixture
def half(tmp_path: Path, first_half: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(first_half, tmp_path / "half")


def newest_first(folder: Path) -> list[Path]:
    """Its checkpoints."""
    return sorted(folder.glob("checkpoint*"), key=lambda path: -read_file(path).number)


LONGER = ["time.end=9.0"]


def go_on(folder: Path) -> None:
    """To the end of the whole run."""
    resume(folder, LONGER, SELF)


# ---------------------------------------------------------------- the same run
def test_a_finished_run_is_lengthened(half: Path, whole: Path) -> None:
    go_on(half)
    assert_same(half, whole)
    log = (half / "run.log").read_text()
    assert (
        "resumes from the checkpoint of time 6, step 6" in log and log.count("INFO finished") == 2
    )


def test_a_run_at_its_end_stays_as_it_is(half: Path) -> None:
    before = rows(half), Recording(half).times.tolist()
    resume(half, [], SELF)
    assert (rows(half), Recording(half).times.tolist()) == before


def test_a_state_comes_back_whole(half: Path) -> None:
    kept = read_checkpoint(half)
    assert kept is not None
    with made(Recording(half).scene) as simulation:
        state = simulation.state
        restore_state(state, kept)
        assert (state.time, state.number, state.loading.values) == (6.0, 6, {"force": 8.0})
        arrays = gather_state(state)
        assert arrays is not None and list(arrays) == kept.functions
        for name, values in arrays.items():
            np.testing.assert_array_equal(values, kept.arrays[f"function/{name}"], err_msg=name)


def test_steps_after_the_checkpoint_are_done_again(half: Path, whole: Path) -> None:
    """As after a kill: two steps of history and fields are newer than the newest checkpoint."""
    older = {path: path.read_bytes() for path in half.glob("checkpoint*")}
    resume(half, ["time.end=8.0"], SELF)
    assert rows(half)[-1][0] == "8.0" and Recording(half).times[-1] == 8.0
    for path, data in older.items():
        path.write_bytes(data)
    (half / "history.csv").open("a").write("9.0,1.2")  # of a row that was cut off
    go_on(half)
    assert_same(half, whole)


def test_the_generation_before_counts_where_the_newest_is_damaged(half: Path, whole: Path) -> None:
    path = newest_first(half)[0]
    with np.load(path) as file:
        place = path.read_bytes().index(file["function/displacement"].tobytes())
    data = bytearray(path.read_bytes())
    data[place] ^= 1  # a bit of a number
    path.write_bytes(data)
    go_on(half)
    assert_same(half, whole)
    log = (half / "run.log").read_text()
    assert "resumes from the checkpoint of time 5, step 5" in log
    assert f"WARNING {path}: is corrupt" in log


@pytest.mark.parametrize("missing", [(), ("history.csv",), ("fields.vtkhdf", "history.csv")])
def test_without_a_checkpoint_it_starts_again(
    half: Path, whole: Path, missing: tuple[str, ...]
) -> None:
    for name in ("checkpoint-a.npz", "checkpoint-b.npz", *missing):
        (half / name).unlink()
    go_on(half)
    assert_same(half, whole)
    assert "no checkpoint: restarting at t = 0" in (half / "run.log").read_text()


def test_a_solve_that_failed_goes_on_with_other_settings(tmp_path: Path) -> None:
    """One Newton iteration is not enough; the checkpoint is of the last step that was accepted."""
    bad = scene(3.0).with_values({"loads.force.ramp": [[0.0, 0.0], [1.0, 0.0], [3.0, 1.0]]})
    folder = tmp_path / "bad"
    strict = bad.with_values({"solver.maximum_iterations": 1, "solver.maximum_halvings": 0})
    with pytest.raises(StepFailure, match="time 2"):
        run(strict, folder, SELF)
    kept = read_checkpoint(folder)
    assert kept is not None and (kept.number, kept.time) == (1, 1.0)
    resume(folder, ["solver.maximum_iterations=25", "solver.maximum_halvings=12"], SELF)
    good = run(bad, tmp_path / "good", SELF)
    assert rows(folder) == rows(good)


# ---------------------------------------------------------------- stops on purpose
def test_a_run_stops_before_its_time_is_over_and_goes_on(tmp_path: Path, whole: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(Paused, match="stopped before --max-wall-time is over") as stop:
        run(scene(), folder, SELF, deadline=clock.monotonic())
    assert stop.value.time == 0.0 and not list(folder.glob("checkpoint*"))
    resume(folder, [], SELF)
    assert_same(folder, whole)


def test_a_signal_lets_the_step_end(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = Staggered.solve

    def signalled(self: Staggered, time: float, loads: dict[str, float]) -> Any:
        if time == 4.0:
            signal.raise_signal(signal.SIGUSR1)
        return solve(self, time, loads)

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Staggered, "solve", signalled)
        with pytest.raises(Paused, match="stopped by SIGUSR1") as stop:
            run(scene(), folder, SELF)
    assert stop.value.time == 4.0 == Recording(folder).history["time"][-1]
    assert time_of_checkpoint(folder) == 4.0
    resume(folder, [], SELF)
    assert_same(folder, whole)


# ---------------------------------------------------------------- refusals
@pytest.mark.parametrize(("change", "message"), table(__file__, "other_scenes.txt"))
def test_another_scene_is_refused_and_nothing_changes(
    half: Path, change: str, message: str
) -> None:
    before = {path.name: path.read_bytes() for path in half.iterdir() if path.name != "run.log"}
    with pytest.raises((SceneError, RecordingError)) as refusal:
        resume(half, [change], SELF)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)
    assert {
        path.name: path.read_bytes() for path in half.iterdir() if path.name != "run.log"
    } == before


def test_another_mesh_is_refused(half: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As another Gmsh may make it of the same scene."""
    nodes = Domain.gather_nodes

    def moved(domain: Domain, values: Any) -> Any:
        found = nodes(domain, values)
        return found if found is None else found + 1e-6

    monkeypatch.setattr(Domain, "gather_nodes", moved)
    with pytest.raises(CheckpointError, match="the checkpoint has another mesh"):
        resume(half, LONGER, SELF)


def test_what_may_change_changes(half: Path) -> None:
    ramp = "loads.force.ramp=[[0, 0], [2, 0.5], [4, 1], [6, 1], [8, 0.5]]"
    resume(half, [ramp, "time.end=8", "output.every=1", "solver.maximum_iterations=30"], SELF)
    recording = Recording(half)
    assert recording.history["force"].tolist() == [0, 2, 4, 6, 8, 8, 8, 6, 4]
    assert recording.times.tolist() == [0, 2, 4, 6, 7, 8]
    assert recording.scene.time.end == 8.0 and recording.scene.solver.maximum_iterations == 30


def test_a_folder_that_a_run_writes_is_refused(half: Path) -> None:
    with (
        RunLock(half),
        pytest.raises(FolderTaken, match=f"half: process {os.getpid()} on .* writes in it"),
    ):
        resume(half, [], SELF)
    assert lock_holder(half) == (None, False)
    resume(half, [], SELF)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(FolderTaken, match="is not the folder of a run, it has no scene.toml"):
            resume(folder, [], SELF)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("last", ["[output]", "every = "])
def test_a_scene_that_was_cut_and_is_valid_still_is_refused(half: Path, last: str) -> None:
    """Defaults would take the place of what is gone; nothing changes."""
    lines = (half / "scene.toml").read_text().splitlines(keepends=True)
    cut = next(number for number, line in enumerate(lines) if line.startswith(last))
    (half / "scene.toml").write_text("".join(lines[:cut]))
    before = (half / "history.csv").read_bytes()
    with pytest.raises(
        RecordingError, match=r"scene.toml: lacks (output|solver)\.[a-z_]+, which the run had"
    ):
        resume(half, ["time.end=9.0"], SELF)
    assert (half / "history.csv").read_bytes() == before


def test_fields_that_are_gone_begin_with_the_next_step(half: Path) -> None:
    (half / "fields.vtkhdf").unlink()
    resume(half, ["time.end=9.0", "output.every=1"], SELF)
    assert Recording(half).times.tolist() == [7.0, 8.0, 9.0]
    assert (
        "WARNING fields.vtkhdf is missing: a new one begins with the next step"
        in (half / "run.log").read_text()
    )


# ---------------------------------------------------------------- other numbers of ranks


def assert_nearly_same(
    found: Path, expected: Path, history: float = 1e-9, values: float = 1e-8
) -> None:
    """Rows, times and names exactly; numbers as another number of ranks allows."""
    mine, others = Recording(found), Recording(expected)
    assert list(mine.history) == list(others.history)
    assert mine.times.tolist() == others.times.tolist()
    np.testing.assert_array_equal(mine.history["time"], others.history["time"])
    assert_close(mine.history, others.history, set(others.history) - {*COUNTED}, history, history)
    kept, wanted = read_checkpoint(found), read_checkpoint(expected)
    assert kept is not None and wanted is not None and kept.number == wanted.number
    np.testing.assert_allclose(structure(kept), structure(wanted), rtol=0, atol=values)
    displacement = [one.arrays["function/displacement"] for one in (kept, wanted)]
    np.testing.assert_allclose(*displacement, rtol=0, atol=values)


def structure(checkpoint: Checkpoint) -> np.ndarray:
    """A at all points, (elements, points, 3, 3)."""
    shape = len(checkpoint.arrays["elements"]), -1
    dimensions = checkpoint.arrays["function/cell_dimensions"].reshape(*shape, 3)
    return structure_tensor(
        dimensions, checkpoint.arrays["function/cell_axes"].reshape(*shape, 3, 3)
    )


@pytest.fixture(scope="module")
def two_ranks(first_half: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """What tests/on_two_ranks.py makes, and what it says; mpirun ends all when the killed rank is gone."""
    folder = tmp_path_factory.mktemp("two")
    shutil.copytree(first_half, folder / "half")
    line = mpirun(
        2, sys.executable, str(Path(__file__).parents[1] / "on_two_ranks.py"), str(folder)
    )
    done = ran(line)
    assert done.returncode != 0 and (folder / "lost").exists(), done.stderr
    return folder, done.stderr


def test_two_ranks_go_on_to_the_last_bit(two_ranks: tuple[Path, str], whole: Path) -> None:
    folder, _ = two_ranks
    assert_same(folder / "resumed", folder / "whole")
    assert_nearly_same(folder / "whole", whole)


def test_it_goes_on_with_another_number_of_ranks(
    two_ranks: tuple[Path, str], tmp_path: Path, whole: Path
) -> None:
    """One, then two, then one."""
    half = shutil.copytree(two_ranks[0] / "half", tmp_path / "half")
    assert Recording(half).history["time"][-1] == 8.0
    assert rows(half)[:8] == rows(whole)[:8] != rows(half)[: len(rows(whole))]
    go_on(half)
    assert_nearly_same(half, whole)


def test_a_rank_without_elements_is_no_hindrance(two_ranks: tuple[Path, str]) -> None:
    kept = read_checkpoint(two_ranks[0] / "one element")
    assert (
        kept is not None and kept.time == 2.0 and kept.arrays["function/displacement"].shape[0] == 1
    )


def test_a_wall_time_that_is_over_is_exit_code_4(two_ranks: tuple[Path, str]) -> None:
    folder, errors = two_ranks
    assert json.loads((folder / "codes.json").read_text()) == {"wall time": 4}
    assert (
        errors.count(
            "remodel-fenicsx: stopped before --max-wall-time is over at time 8; all steps are saved. Resume: "
        )
        == 1
    )


def test_a_lost_rank_loses_the_steps_since_the_checkpoint(
    two_ranks: tuple[Path, str], tmp_path: Path, whole: Path
) -> None:
    """The other rank does not go on alone; nobody holds the folder."""
    lost = shutil.copytree(two_ranks[0] / "lost", tmp_path / "lost")
    assert time_of_checkpoint(lost) == 4.0 and Recording(lost).history["time"][-1] == LOST_AT - 1
    assert not lock_holder(lost)[1]
    resume(lost, [], SELF)
    assert_nearly_same(lost, whole)


# ---------------------------------------------------------------- the command
def test_a_signal_is_exit_code_4_and_one_line_says_how_to_go_on(half: Path, whole: Path) -> None:
    """While it runs the folder is held; who is killed leaves its name there."""
    words = ["run", "--resume", str(half), "-q", "--set", "time.end=500.0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "remodel_fenicsx.cli", *words],
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    deadline = clock.monotonic() + 200
    while clock.monotonic() < deadline and len(rows(half)) < 12:
        clock.sleep(0.02)
        assert process.poll() is None
    with pytest.raises(
        FolderTaken, match=f"process {process.pid} on {socket.gethostname()} writes in it"
    ):
        resume(half, [], SELF)
    assert f"running: process {process.pid} on " in "\n".join(status(half))
    os.killpg(process.pid, signal.SIGUSR1)
    errors = process.communicate(timeout=100)[1]
    last = Recording(half).history["time"][-1]
    assert process.returncode == 4
    assert errors.count("\n") == 1 and f"{command_name()} run --resume {half}" in errors
    assert time_of_checkpoint(half) == last and rows(half)[:10] == rows(whole)[:10]
    said = status(half)
    assert said[0] == f"{half}: scene, step {last:g} of 500, time {last:g} of 500"
    assert said[1].startswith("not running") and said[1].endswith("; stopped by SIGUSR1")
    assert said[3].startswith(f"checkpoint at time {last:g}; ")


def test_the_status_of_a_run(half: Path) -> None:
    assert status(half)[0] == f"{half}: scene, step 6 of 6, time 6 of 6"
    assert status(half)[1] == "finished" and status(half)[-1] == "checkpoint at time 6"
    assert re.fullmatch(r"[\d.e-]+ s a step \(mean of the last 6\)", status(half)[2])
    (half / "scene.toml").write_text(
        (half / "scene.toml").read_text().replace("end = 6.0", "end = 12.0")
    )
    with RunLock(half):
        said = status(half)
        assert (
            said[1].startswith(f"running: process {os.getpid()} on ")
            and " left; the last step was done " in said[1]
        )
        left = (half / "run.lock").read_bytes()
    (half / "run.lock").write_bytes(left)  # as a process leaves it that is killed
    assert status(half)[1].endswith(f"; process {os.getpid()} on {socket.gethostname()} was killed")


def test_the_status_of_a_run_that_failed_says_why(tmp_path: Path) -> None:
    """Until it goes on: then the end of before is none any more."""
    scene = pulled_cube(6.0).with_values({"loads.force.value": 1e9, "solver.maximum_halvings": 0})
    with pytest.raises(StepFailure, match="no equilibrium at time 1"):
        run(scene, tmp_path / "out", MPI.COMM_SELF)
    assert status(tmp_path / "out")[1].startswith("failed: no equilibrium at time 1: ")
    with (tmp_path / "out" / "run.log").open("a") as log:
        log.write("2026-01-01 00:00:00,000 INFO ended: SIGTERM\n")
    assert status(tmp_path / "out")[1].endswith("; stopped by SIGTERM")


@pytest.mark.parametrize(("every", "seconds", "cost", "number", "due"), [
    (3, 0.0, 0.0, 6, True), (3, 9e9, 0.0, 7, False), (0, 9e9, 0.0, 6, False), (None, 9.0, 0.0, 6, False),
    (None, 11.0, 0.0, 6, True),
    (None, 49.0, 2.0, 6, False), (None, 51.0, 2.0, 6, True),  # 4 % of the time
    (None, 610.0, 60.0, 6, True), (None, 590.0, 60.0, 6, False),  # what is lost is 10 minutes
])  # fmt: skip
def test_when_a_checkpoint_is_due(
    every: int | None, seconds: float, cost: float, number: int, due: bool
) -> None:
    checkpoints = Checkpoints.__new__(Checkpoints)
    checkpoints.every, checkpoints._cost = every, cost
    checkpoints._written_at = clock.monotonic() - seconds
    checkpoints.state = SimpleNamespace(comm=SELF)  # type: ignore[assignment]
    assert checkpoints._is_due(number) == due


def test_what_a_coupling_remembers_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A function and a number of its own, through a failure and a checkpoint."""

    class Remembering(Staggered):
        def __init__(self, state: State, *others: Any):
            super().__init__(state, *others)
            self.earlier = state.unknown.copy()
            self.earlier.name = "earlier_displacement"
            state.remember(self.earlier)
            with pytest.raises(ValueError, match="has a function 'earlier_displacement' already"):
                state.remember(self.earlier)

        def solve(self, time: float, loads: dict[str, float]) -> Work:
            self.earlier.x.array[:] = self.state.unknown.x.array
            self.state.numbers["part"] = self.state.numbers.get("part", 0.5) / 2
            if time == 3.0 and fails:
                raise RuntimeError("tired")
            return super().solve(time, loads)

    monkeypatch.setitem(COUPLINGS, "staggered", CouplingKind("as before", Remembering))
    fails = True
    with pytest.raises(RuntimeError, match="tired"):
        run(scene(4.0, checkpoint=1), tmp_path / "run", SELF)
    second, first = map(read_file, newest_first(tmp_path / "run"))
    earlier = second.arrays["function/earlier_displacement"]
    np.testing.assert_array_equal(earlier, first.arrays["function/displacement"])
    assert np.ptp(earlier) > 0 and second.numbers["part"] == 0.125 and second.number == 2
    fails = False
    resume(tmp_path / "run", [], SELF)
    kept = read_checkpoint(tmp_path / "run")
    assert kept is not None and kept.numbers["part"] == 0.5**5
