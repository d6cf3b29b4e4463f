"""Runs that are killed or meet a full disk, at any moment, in a write too: in the end the whole run is there."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from remodel_fenicsx.results import checkpoint
from remodel_fenicsx.results.recording import read_history
from remodel_fenicsx.results.run_folder import FolderTaken, History
from remodel_fenicsx.results.vtkhdf import DeferredErrorFile, TransientGrid
from remodel_fenicsx.running import resume, run
from tests.forks import forked
from tests.results.test_resume import (
    LONGER,
    SELF,
    assert_same,
    first_half,
    half,
    rows,
    scene,
    whole,
)

__all__ = ["first_half", "half", "whole"]  # fixtures


# ---------------------------------------------------------------- in the middle of a write
class Camera:
    """Copies a folder as it is before, and in the middle of, what changes the disk; so many random moments of all.

    What a process that is killed there leaves behind.
    """

    def __init__(self, folder: Path, copies: Path, seed: int, number: int):
        self.folder, self.copies, self.number = folder, copies, number
        self.random, self.seen = random.Random(seed), 0
        self.moments: dict[Path, str] = {}

    def look(self, what: str) -> None:
        """Every moment has the same chance to be kept."""
        self.seen += 1
        place = self.seen - 1 if self.seen <= self.number else self.random.randrange(self.seen)
        if place < self.number:
            copy = self.copies / str(place)
            shutil.rmtree(copy, ignore_errors=True)
            if self.folder.exists():
                shutil.copytree(self.folder, copy)
                self.moments[copy] = f"moment {self.seen}: {what}"

    @contextmanager
    def running(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        """Within, it looks."""
        write, row = DeferredErrorFile.write, History._write

        def half_and_whole(file: DeferredErrorFile, data: Any) -> int:
            self.look("before a write of fields")
            place = file.tell()
            write(file, bytes(data)[: len(data) // 2])
            self.look("in a write of fields")
            file.seek(place)
            return write(file, data)

        def half_row(history: History, data: bytes) -> None:
            history._file.write(data[: len(data) // 2])
            self.look("in a row")
            history._cut()
            row(history, data)

        def before(owner: Any, name: str) -> None:
            real: Callable[..., Any] = getattr(owner, name)

            def looking(*arguments: Any, **options: Any) -> Any:
                self.look(f"before {name}")
                return real(*arguments, **options)

            patch.setattr(owner, name, looking)

        with monkeypatch.context() as patch:
            patch.setattr(DeferredErrorFile, "write", half_and_whole)
            patch.setattr(History, "_write", half_row)
            for owner, name in (
                (os, "link"),
                (os, "fsync"),
                (Path, "replace"),
                (Path, "rename"),
                (Path, "unlink"),
            ):
                before(owner, name)
            yield


@pytest.mark.parametrize(("kind", "seed"), [("new", 1), ("resumed", 2), ("restarted", 3)])
def test_a_run_that_is_killed_in_a_write_goes_on(
    kind: str, seed: int, half: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new run; one that goes on; one that starts again, for it was killed before its first checkpoint."""
    folder = half
    if kind == "new":
        folder = tmp_path / "run"
    elif kind == "restarted":
        for path in half.glob("checkpoint*"):
            path.unlink()
    camera = Camera(folder, tmp_path / "copies", seed, number=3)
    with camera.running(monkeypatch):
        if kind == "new":
            run(scene(checkpoint=2), folder, SELF)
        else:
            resume(folder, LONGER, SELF)
    assert camera.seen > 100 and len(camera.moments) == 3
    assert_same(folder, whole)
    for copy, moment in camera.moments.items():
        print(f"seed {seed}, {moment}")
        try:
            resume(copy, LONGER, SELF)
        except FolderTaken:
            assert not (copy / "scene.toml").exists(), moment
        else:
            assert_same(copy, whole)


# ---------------------------------------------------------------- kill -9


def words_for(folder: Path, scene_file: Path) -> list[str]:
    """Of the run, or of what goes on with it."""
    if folder.exists() and not (folder / "scene.toml").exists():  # killed before there was anything
        shutil.rmtree(folder)
    begun = ["--resume", folder] if folder.exists() else [scene_file, "-o", folder]
    return ["run", *map(str, begun), "-q"]


def killed_at_random(folder: Path, scene: str, program: str, kills: int) -> None:
    """Whole runs, killed so many times at random moments and gone on with, are the run that nobody kills."""
    (folder / "scene.toml").write_text(scene)
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    moments, done, whole = random.Random(seed), 0, 0

    def status(run: str, seconds: float | None) -> int:
        words = words_for(folder / run, folder / "scene.toml")
        return forked(program, *words, seconds=seconds).returncode

    assert status("expected", None) == 0
    while done < kills:
        ended = status(f"run-{whole}", moments.uniform(0.1, 0.4))
        assert ended in (0, -signal.SIGKILL)
        done, whole = done + (ended != 0), whole + (ended == 0)
    assert status(f"run-{whole}", None) == 0
    for number in range(whole + 1):
        assert_same(folder / f"run-{number}", folder / "expected")


GROWING = """
preset = "consistent"
geometry = {shape = "tube", inner_radius = 1.0, outer_radius = 1.3}
model = {kinematics = "radial"}
mesh = {degree = 2}
cells = {initial = "isotropic"}
remodeling = {turnover = {time = 10.0}}
time = {end = 80.0, step = 2.0}
loads.pressure = {value = 1.2, ramp = [[0.0, 0.0], [8.0, 1.0]]}
loads.elongation = {value = 0.1, ramp = [[0.0, 0.0], [8.0, 1.0]]}
output = {fields = ["content", "natural_length"], every = 8, checkpoint = 2, report = false, columns = COLUMNS}
cases = [{weight = 0.6, loads = {pressure = 0.8}}, {weight = 0.4, loads = {pressure = 1.3}}]
"""


def test_load_cases_and_turnover_survive_kills(tmp_path: Path) -> None:
    """Content, natural length and the unknowns of each case go on to the last digit."""
    columns = ["content", "natural_length", "inner_radius", "fibre_angle_outer", "seconds"]
    killed_at_random(tmp_path, GROWING.replace("COLUMNS", str(columns)), "remodel-fenicsx", kills=5)
    table = read_history(tmp_path / "expected")
    assert (
        table["content"][-1] > 1.3
        and table["inner_radius@2"][-1] > table["inner_radius"][-1] + 0.05
    )


# ---------------------------------------------------------------- a full disk
def system_call(name: str, *arguments: Any) -> None:
    """One of libc's that return 0, or OSError; the environment has no program for these two."""
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(*arguments):
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of two megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    place = str(folder).encode()
    try:
        system_call("mount", b"tmpfs", place, b"tmpfs", 0, b"size=2m")
    except OSError as error:
        pytest.skip(f"NO SMALL DISK CAN BE MOUNTED HERE, so a full one is not tested: {error}")
    yield folder
    gc.collect()  # files that an exception has kept open
    system_call("umount2", place, 2)  # 2: as soon as nobody uses it


def fill(disk: Path) -> None:
    """Leave no room."""
    with (disk / "filler").open("ab", buffering=0) as file:
        try:
            while file.write(bytes(4096)):
                pass
        except OSError as error:
            assert error.errno == errno.ENOSPC


@pytest.mark.parametrize("what", ["fields", "checkpoint"])
def test_a_full_disk_loses_nothing(
    what: str, disk: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every finished row is there; with room again the run goes on to its end."""
    settings = scene(6.0, checkpoint=1).with_values(
        {"time.step": 0.25, "output.fields": what == "fields"}
    )
    expected = run(settings, tmp_path / "expected", SELF)
    folder, calls = disk / "run", []

    def before(owner: Any, name: str, full: Callable[..., bool]) -> None:
        real: Callable[..., Any] = getattr(owner, name)

        def filling(*arguments: Any, **options: Any) -> Any:
            if full(*arguments):
                calls.append(name)
                fill(disk)
            return real(*arguments, **options)

        patch.setattr(owner, name, filling)

    with monkeypatch.context() as patch:
        if what == "fields":
            before(TransientGrid, "append", lambda grid, time, *_: time >= 4.0)
        else:
            before(checkpoint, "write_checkpoint", lambda folder, kept: kept.time >= 4.0)
        with pytest.raises(OSError) as full:
            run(settings, folder, SELF)
    assert full.value.errno == errno.ENOSPC and calls
    left = rows(folder)
    assert left == rows(expected)[: len(left)] and len(left) > 10
    (disk / "filler").unlink()
    resume(folder, [], SELF)
    assert_same(folder, expected)


READ_ONLY, REMOUNT = 1, 32  # flags of mount(2)


def test_a_disk_that_cannot_be_written_is_exit_code_5(disk: Path, half: Path) -> None:
    folder = shutil.copytree(half, disk / "run")
    system_call("mount", b"tmpfs", str(disk).encode(), b"tmpfs", READ_ONLY | REMOUNT, None)
    done = forked("remodel-fenicsx", "run", "--resume", folder, "--set", "time.end=9")
    assert done.returncode == 5 and done.stdout == "", done.stderr
    assert done.stderr.startswith("remodel-fenicsx: cannot write the results: ")
    assert done.stderr.endswith("run.lock: Read-only file system\n")
    assert done.stderr.count("\n") == 1
