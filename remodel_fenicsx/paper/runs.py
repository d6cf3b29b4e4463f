"""The runs behind the figures: which scenes they need, and a cache of recorded runs that are still valid."""

from __future__ import annotations

import ast
import ctypes
import fcntl
import hashlib
import importlib.metadata
import json
import os
import shutil
import secrets
import signal
import subprocess
import sys
import time as clock
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import remodel_fenicsx
from remodel_fenicsx.paper.recordings import Recording
from remodel_fenicsx.system.interrupts import StopRequest
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.system.terminal import announce

PRESET = "kuhl-holzapfel-2007"
KAPPAS = (0.01, 0.025, 0.05, 0.1)  # those of the printed Fig. 5 cannot be read
LOAD_CASES = ((0.10, 0.0), (0.10, 2.4), (0.10, 4.8), (0.05, 4.8), (0.0, 4.8))  # Fig. 9: (stretch, pressure)

# parts of the package that change no number of a run
_NOT_NUMBERS = ("paper", "system", "cli.py")
_DISTRIBUTIONS = ("fenics-dolfinx", "fenics-ufl", "fenics-ffcx", "petsc4py", "gmsh", "numpy")
_PART = ".part-"  # and numbers: an unfinished run
_POLL, _LINE_EVERY = 0.25, 10.0  # seconds


class FigureError(Exception):
    """No figure for a reason that its one line names; `exit_code` is the command's."""

    def __init__(self, message: str, exit_code: int):
        super().__init__(message)
        self.exit_code = exit_code


def load_case_name(stretch: float, pressure: float) -> str:
    """Name of the run of one of Fig. 9's load cases."""
    return "artery" if (stretch, pressure) == (0.10, 4.8) else f"artery-{100 * stretch:g}-{pressure:g}"


def scenes() -> dict[str, Scene]:
    """Every scene that a figure needs, by name: the paper's preset with what the figure varies."""
    found = {"tendon": preset_scene(PRESET, "tendon"), "artery": preset_scene(PRESET, "tube")}
    last_only = {"output.every": found["artery"].time.number_of_steps}
    for stretch, pressure in LOAD_CASES:
        changes = {"loads.elongation.value": stretch, "loads.pressure.value": pressure}
        found.setdefault(load_case_name(stretch, pressure), found["artery"].with_values(changes | last_only))
    for driver in ("pk2", "finger"):
        found[f"artery-{driver}"] = found["artery"].with_values({"remodeling.driver": driver} | last_only)
    found["artery-rate"] = found["artery"].with_values({"remodeling.law": "rate"} | last_only)
    for kappa in KAPPAS:
        changes = {"remodeling.kappa": kappa, "output.fields": False}
        found[f"cube-{kappa:g}"] = preset_scene(PRESET, "cube").with_values(changes)
    return {name: scene.with_values({"name": name}) for name, scene in found.items()}


# ---------------------------------------------------------------- validity


def source_fingerprint(package: Path = Path(remodel_fenicsx.__file__).parent) -> str:
    """Hash of all source that decides a run's numbers; comments, docstrings and layout do not change it."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package)
        if name.parts[0] not in _NOT_NUMBERS:
            digest.update(f"{name.as_posix()}\n{ast.dump(_without_docstrings(path))}\n".encode())
    return digest.hexdigest()


def _without_docstrings(path: Path) -> ast.Module:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # a lambda's body is none
            node.body = [part for part in body if not _is_text(part)]  # type: ignore[attr-defined]
    return tree


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def library_versions() -> dict[str, str]:
    """Versions of the libraries that decide a run's numbers, without importing them."""
    return {name: importlib.metadata.version(name) for name in _DISTRIBUTIONS}


def run_key(scene: Scene, source: str, libraries: Mapping[str, str]) -> str:
    """What a recorded run depends on, as one hash: the scene with all its defaults, the source, the libraries."""
    everything = json.dumps([scene.model_dump(mode="json"), source, dict(libraries)], sort_keys=True)
    return hashlib.sha256(everything.encode()).hexdigest()[:12]


@dataclass
class RunCache:
    """Recorded runs in a folder, each in NAME-KEY: a run whose scene, source or libraries have changed has another key.

    Parameters
    ----------
    folder
        Where the runs are; made when the first one is.
    source, libraries
        What the present numbers depend on beside the scene.
    """

    folder: Path
    source: str = field(default_factory=source_fingerprint)
    libraries: Mapping[str, str] = field(default_factory=library_versions)

    def path(self, scene: Scene) -> Path:
        """Folder of a scene's run, whether it exists or not."""
        return self.folder / f"{scene.name}-{run_key(scene, self.source, self.libraries)}"

    def is_valid(self, scene: Scene) -> bool:
        """Whether a whole run of this very scene with the present source and libraries is recorded."""
        return Recording(self.path(scene)).fault(scene) is None

    def obtain(self, wanted: Iterable[Scene], jobs: int) -> dict[str, Path]:
        """Folders by name of scene; what is not valid is run first, so many at a time.

        Raises
        ------
        FigureError
            If a run fails (with its exit code) or the command is stopped (130, 143). Finished runs stay.
        OSError
            If the folder cannot be written.
        """
        _remove_litter(self.folder)
        wanted = list(wanted)
        missing = [scene for scene in wanted if not self.is_valid(scene)]
        if missing:
            self.folder.mkdir(parents=True, exist_ok=True)
            for folder, scene in ((self.path(scene), scene) for scene in missing):
                if folder.exists():
                    line = Line()
                    line.show(f"figures: run again: {folder}: {Recording(folder).fault(scene)}", at_once=True)
                    line.end()
            _Pool(self, missing, jobs).run()
        return {scene.name: self.path(scene) for scene in wanted}


# ---------------------------------------------------------------- running


class _Pool:
    """Runs scenes in processes of their own, the longest first."""

    def __init__(self, cache: RunCache, missing: list[Scene], jobs: int):
        self.cache, self.jobs = cache, jobs
        cost = {"tube": 5.0, "tendon": 1.0, "cube": 0.05}
        self.waiting = sorted(missing, key=lambda scene: cost[scene.geometry.name] * scene.time.number_of_steps)
        self.running: list[_Run] = []
        self.total, self.finished_steps = sum(scene.time.number_of_steps for scene in missing), 0
        self.progress = Line()

    def run(self) -> None:
        with StopRequest() as stop:
            try:
                while self.waiting or self.running:
                    if stop.number:
                        raise FigureError("stopped; finished runs are kept", 128 + stop.number)
                    while self.waiting and len(self.running) < self.jobs:
                        self.running.append(_Run(self.cache, self.waiting.pop()))
                    self._collect()
                    self._report()
                    clock.sleep(_POLL)
            finally:
                for run in self.running:
                    run.stop()
                self.progress.end()

    def _collect(self) -> None:
        for run in list(self.running):
            if run.process.poll() is not None:
                self.running.remove(run)
                run.finish()
                self.finished_steps += run.scene.time.number_of_steps

    def _report(self) -> None:
        done = self.finished_steps + sum(run.steps_done() for run in self.running)
        parts = [f"{run.scene.name} {run.steps_done()}/{run.scene.time.number_of_steps}" for run in self.running]
        waiting = f", {len(self.waiting)} more to start" if self.waiting else ""
        self.progress.show(f"figures: {100 * done // self.total} % of the runs: {', '.join(parts)}{waiting}")


class _Run:
    """One scene in one process; its folder gets its name only when it is whole.

    What the process says goes to `messages`, which is locked by this process and by that one, whose output it is: as
    long as one of them lives, nobody takes the unfinished folder for litter (`_remove_litter`).
    """

    def __init__(self, cache: RunCache, scene: Scene):
        self.scene, self.source, self.target = scene, cache.source, cache.path(scene)
        self.part = self.target.with_name(f"{self.target.name}{_PART}{os.getpid()}-{secrets.token_hex(3)}")
        self.scene_file, self.messages = (Path(f"{self.part}{ending}") for ending in (".toml", ".txt"))
        self.lock = _locked(self.messages)
        self.scene_file.write_text(scene.to_toml(), encoding="utf-8")
        command = [sys.executable, "-m", "remodel_fenicsx.cli", "run", str(self.scene_file)]
        command += ["-o", str(self.part), "--quiet"]
        # this very package, wherever it was imported from; one thread each, as there are jobs for the cores
        paths = [str(Path(remodel_fenicsx.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(command, stdout=self.lock, stderr=self.lock, stdin=subprocess.DEVNULL,
                                        env=environment, preexec_fn=_EndWithParent())  # fmt: skip

    def steps_done(self) -> int:
        try:
            return max(0, (self.part / "history.csv").read_bytes().count(b"\n") - 1)
        except OSError:
            return 0

    def finish(self) -> None:
        """Give the folder its name, or say why there is none."""
        said = self.messages.read_text(errors="replace").strip().splitlines()
        code = self.process.returncode
        try:
            self._name_folder(said, code)
        finally:
            self._remove_files()

    def _remove_files(self) -> None:
        """The lock goes last."""
        self.scene_file.unlink(missing_ok=True)
        self.messages.unlink(missing_ok=True)
        self.lock.close()

    def _name_folder(self, said: list[str], code: int) -> None:
        if code != 0:
            last = said[-1].removeprefix("remodel-fenicsx: ") if said else "it said nothing"
            message = f"the run {self.scene.name} in {self.part}: {last}"
            raise FigureError(message, code if code > 0 else 128 - code)
        if source_fingerprint() != self.source:
            shutil.rmtree(self.part)
            raise FigureError(f"the package's source changed during the run {self.scene.name}: start again", 1)
        try:
            self.part.rename(self.target)
        except OSError:
            if not self.target.is_dir():
                raise
            # the same run by another process in the meantime, or what is left of one that is not whole
            shutil.rmtree(self.target)
            self.part.rename(self.target)

    def stop(self) -> None:
        """End the process; its unfinished folder goes with it."""
        self.process.terminate()
        try:
            self.process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self.part, ignore_errors=True)
        self._remove_files()


class _EndWithParent:
    """Called in a child before it starts its program: the kernel ends it with the process that made it, even killed.

    (Linux only; elsewhere such a run goes on to its end.) What it needs is loaded before the fork.
    """

    _SET_SIGNAL = 1  # PR_SET_PDEATHSIG

    def __init__(self) -> None:
        self.parent, self.control = os.getpid(), None
        if sys.platform == "linux":
            self.control = ctypes.CDLL(None).prctl

    def __call__(self) -> None:
        if self.control is not None:
            self.control(self._SET_SIGNAL, int(signal.SIGTERM), 0, 0, 0)
            if os.getppid() != self.parent:  # it was gone before
                os._exit(128 + int(signal.SIGTERM))


def _locked(path: Path) -> TextIO:
    """A file that is locked until it is closed, here and in every child that has it for its output."""
    while True:
        file = path.open("a")
        fcntl.flock(file, fcntl.LOCK_EX)
        if path.exists():
            return file
        file.close()  # another command took it for litter before it was locked


def _remove_litter(folder: Path) -> None:
    """Remove what failed runs and killed commands have left: unfinished runs whose messages nobody locks any more."""
    for messages in folder.glob(f"*{_PART}*.txt"):
        with messages.open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:  # a run under way
                continue
            shutil.rmtree(messages.with_suffix(""), ignore_errors=True)
            messages.with_suffix(".toml").unlink(missing_ok=True)
            messages.unlink(missing_ok=True)
    for part in folder.glob(f"*{_PART}*/"):
        if not Path(f"{part}.txt").exists():  # made before the folder, removed after it
            shutil.rmtree(part, ignore_errors=True)


class Line:
    """The progress on stderr: one line that changes on a terminal, else a plain line now and then."""

    def __init__(self) -> None:
        self._last, self._terminal, self._width = -1e9, sys.stderr.isatty(), 0

    def show(self, text: str, at_once: bool = False) -> None:
        """Show a line; where lines stay, only now and then unless it is wanted at once."""
        if self._terminal:
            text = text[: max(20, shutil.get_terminal_size().columns - 1)]
            announce(f"\r{text:{self._width}}", end="")
            self._width = len(text)
        elif at_once or clock.monotonic() - self._last >= _LINE_EVERY:
            announce(text)
            self._last = clock.monotonic()

    def end(self) -> None:
        """Leave the last line as it is."""
        if self._width:
            announce("")
            self._width = 0


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))
