"""Runs that several tests look at are made once for a test session, also when pytest runs on several processes."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import cli
from remodel_fenicsx.system import children
from tests.forks import ForkedChild, end_forks, forked, readers_are_forks

CASE = Path(__file__).with_name("run_case.py")
Case = Callable[..., dict[str, Any]]
Refused = Callable[..., str]
Cases = Callable[[Sequence[dict[str, Any]], int], list[dict[str, Any]]]


def mpirun(ranks: int, *command: str) -> list[str]:
    """A command on so many ranks; --oversubscribe, because a test machine may have fewer cores."""
    return [*command] if ranks == 1 else ["mpirun", "--oversubscribe", "-n", str(ranks), *command]


def slowly(*cases: Any) -> list[Any]:
    """Cases of a parametrised test that only `-m slow` runs, where the others already show what it tells."""
    return [
        pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.slow)
        for one in cases
    ]


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What has been logged as a warning, or as worse."""
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


@contextmanager
def forked_children() -> Iterator[None]:
    """Within, the runs that figures, ensembles and trades start are forked, one after the other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            children,
            "subprocess",
            SimpleNamespace(**vars(children.subprocess) | {"Popen": ForkedChild}),
        )
        yield


@pytest.fixture(scope="session")
def display() -> Iterator[dict[str, str]]:
    """Variables of one window system for all that is drawn in space; none where VTK gets by without."""
    told = "import json, os, sys; print(json.dumps({**os.environ}), flush=True); sys.stdin.read()"
    command = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", sys.executable, "-c", told]
    if shutil.which("xvfb-run"):
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as shown:
            inside = json.loads(shown.stdout.readline())  # type: ignore[union-attr]
            yield {name: inside[name] for name in ("DISPLAY", "XAUTHORITY")}
            shown.stdin.close()  # type: ignore[union-attr]
    else:
        yield {}


@pytest.fixture
def drawn_by_forks(display: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures in space are drawn by children of the process that has imported all."""
    program = "import sys; from remodel_fenicsx import pictures; pictures.main(sys.argv[1])"
    imports = ("remodel_fenicsx.pictures", "pyvista.plotting", "matplotlib.backends.backend_agg")

    def draw(
        command: Sequence[str], env: dict[str, str], **_: Any
    ) -> subprocess.CompletedProcess[str]:
        return forked("python", program, command[-1], variables=env | display, imports=imports)

    drawing = SimpleNamespace(**vars(subprocess) | {"run": draw})
    monkeypatch.setattr("remodel_fenicsx.pictures.subprocess", drawing)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """refused(words of a command) -> what it says: in one line, with exit code 2."""

    def run(*words: str | Path) -> str:
        capsys.readouterr()
        assert cli.main([*map(str, words)]) == 2
        said = capsys.readouterr()
        assert (
            said.out == ""
            and said.err.count("\n") == 1
            and said.err.startswith("remodel-fenicsx: ")
        ), said
        return said.err.removeprefix("remodel-fenicsx: ")

    return run


@pytest.fixture(scope="session", autouse=True)
def forks_end_with_the_session() -> Iterator[None]:
    """Whoever asked for them."""
    readers_are_forks()
    yield
    end_forks()


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Cases:
    """cases(arguments of `case`, ranks) -> what each of them saved; those that are not there yet start together.

    With one that a test file lists as ON_ONE_AND_TWO_RANKS start those of all files of this session: ranks start once.
    """
    modules = dict.fromkeys(getattr(item, "module", None) for item in request.session.items)
    on_both = [
        arguments for module in modules for arguments in getattr(module, "ON_ONE_AND_TWO_RANKS", ())
    ]
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cases"
    folder.mkdir(exist_ok=True)

    def run(wanted: Sequence[dict[str, Any]], ranks: int) -> list[dict[str, Any]]:
        requests: dict[Path, str] = {}
        together = on_both if any(arguments in on_both for arguments in wanted) else []
        for arguments in (*wanted, *together):
            text = json.dumps({"divisions": None} | arguments, sort_keys=True)
            requests[
                folder / (hashlib.sha256(f"{ranks} {text}".encode()).hexdigest()[:16] + ".npz")
            ] = text
        with ExitStack() as locked:
            for out in sorted(requests):
                fcntl.flock(locked.enter_context(out.with_suffix(".lock").open("w")), fcntl.LOCK_EX)
            parts = {out: out.with_suffix(".part.npz") for out in requests if not out.exists()}
            words = [str(word) for out, part in parts.items() for word in (part, requests[out])]
            if words and ranks == 1:
                done = forked("case", *words)
            elif words:
                command = mpirun(ranks, sys.executable, "-m", "mpi4py", str(CASE), *words)
                done = subprocess.run(command, capture_output=True, text=True, timeout=900)
            assert not words or done.returncode == 0, done.stderr[-3000:]
            for out, part in parts.items():
                part.rename(out)
        found = []
        for out in [*requests][: len(wanted)]:
            with np.load(out) as data:
                found.append(dict(data))
        return found

    return run


@pytest.fixture(scope="session")
def case(cases: Cases) -> Case:
    """case(scene, ranks=1, divisions=None) -> what tests/run_case.py saved, by name."""

    def run(scene: dict[str, Any], ranks: int = 1, **others: Any) -> dict[str, Any]:
        (found,) = cases([{"scene": scene, **others}], ranks)
        return found

    return run


@pytest.fixture(scope="module")
def both_ranks(cases: Cases, request: pytest.FixtureRequest) -> list[tuple[dict, dict]]:
    """What the cases of ON_ONE_AND_TWO_RANKS of a test file saved: on one rank, and on two."""
    wanted = request.module.ON_ONE_AND_TWO_RANKS
    return [*zip(*(cases(wanted, ranks) for ranks in (1, 2)), strict=True)]
