"""Studies on a real Dask scheduler with two workers on this machine, which are killed, stopped and edited."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from remodel_fenicsx.results.recording import read_history
from tests.command.test_extensions import DRIVER, SCENE
from tests.processes import CHILDREN, has_ended, members, wait_for_rows

AXIS = "loads.force.value=5:10:12"
PROJECT = Path(__file__).parents[2]
COMMAND = """import sys; from remodel_fenicsx.system import children; from remodel_fenicsx.cli import main
children.SECONDS_TO_END = float(sys.argv.pop(1)); sys.exit(main(sys.argv[1:]))"""


KILLER = """import os, time
from remodel_fenicsx import running

def run(scene, *others, whole=running.run, **options):
    if scene.loads["force"].value == 5:
        os.kill(os.getppid(), 9)
        time.sleep(9)
    return whole(scene, *others, **options)

running.run = run
"""
KILLED_ONCE = """import os, time
from remodel_fenicsx.results import checkpoint

def write_checkpoint(folder, *contents, whole=checkpoint.write_checkpoint):
    whole(folder, *contents)
    if folder.name.endswith("-5") and not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getppid(), 9)
        time.sleep(9)

checkpoint.write_checkpoint = write_checkpoint
"""


def sweep(folder: Path, *words: str, seconds: float = 30.0) -> subprocess.Popen[str]:
    """Start a sweep in a folder."""
    scene = folder / "cube.toml"
    scene.write_text(SCENE.replace("mine", "cauchy").replace("2.0", "100.0"))
    command = [sys.executable, "-c", COMMAND, str(seconds), "sweep", str(scene), AXIS, *words]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


class Engine:
    """A scheduler and its workers; all that they have started."""

    def __init__(self, folder: Path):
        self.folder, self.file, self.workers = folder, folder / "scheduler.json", []
        self.scheduler = self.start(
            "scheduler", "--no-dashboard", "--host", "127.0.0.1", "--port", "0"
        )
        while not self.file.exists():
            time.sleep(0.05)
        self.commands: list[subprocess.Popen[str]] = []

    def start(self, what: str, *words: str, **variables: str) -> subprocess.Popen[bytes]:
        """Start a process of Dask."""
        program = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{what}",
            "--scheduler-file",
            str(self.file),
        ]
        with (self.folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(
                [*program, *words], stderr=log, cwd=self.folder, env=os.environ | variables
            )

    def add_workers(self, number: int = 2, **variables: str) -> None:
        """Start workers; a command waits for the first of them."""
        words = "--no-nanny --no-dashboard --nthreads 1 --memory-limit 0 --host 127.0.0.1".split()
        self.workers += [self.start("worker", *words, **variables) for _ in range(number)]

    def study(self, *words: str, seconds: float = 30.0) -> subprocess.Popen[str]:
        """Start a sweep on the workers."""
        return self.alone(*words, "--scheduler", str(self.file), seconds=seconds)

    def alone(self, *words: str, seconds: float = 30.0) -> subprocess.Popen[str]:
        """Start a sweep without them."""
        self.commands.append(sweep(self.folder, *words, seconds=seconds))
        return self.commands[-1]

    def at_work(self) -> set[int]:
        """Return what the workers have started."""
        return {number for worker in self.workers for number in members(worker.pid, CHILDREN)}

    def wait_for_steps(
        self, study: subprocess.Popen[str], out: str = "out", rows: int = 15
    ) -> Path:
        """Wait until a member is under way; return its folder."""
        while not (found := list((self.folder / out).glob("*/history.csv"))):
            assert study.poll() is None, study.communicate()
            time.sleep(0.02)
        wait_for_rows(study, found[0].parent, rows)
        return found[0].parent


@contextmanager
def started(folder: Path) -> Iterator[Engine]:
    """A scheduler with two workers; all of them end."""
    made = Engine(folder)
    made.add_workers()
    yield made
    for process in (*made.commands, *made.workers, made.scheduler):
        process.kill()
        process.wait()


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    """That a test may kill parts of."""
    with started(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    """For all tests that leave its workers as they are."""
    with started(tmp_path_factory.mktemp("engine")) as made:
        yield made


@pytest.fixture
def shared(lasting: Engine, tmp_path: Path) -> Engine:
    """With studies in a folder of the test."""
    lasting.folder = tmp_path
    return lasting


def ended(study: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """Exit code and lines of a study."""
    said = study.communicate(timeout=200)[1]
    return study.returncode, said.splitlines()


def numbers(folder: Path) -> dict[str, dict[str, list[float]]]:
    """What the members of a study have recorded, but for times of the machine."""
    return {
        path.parent.name: {
            name: list(values)
            for name, values in read_history(path.parent).items()
            if "seconds" not in name
        }
        for path in folder.glob("*/history.csv")
    }


def are_stopped(recorded: dict[str, dict[str, list[float]]]) -> bool:
    """Whether a member has ended before its last step."""
    return any(history["time"][-1] < 100 for history in recorded.values())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, list[float]]]:
    """The sweep without a scheduler."""
    folder = tmp_path_factory.mktemp("whole")
    study = sweep(folder, "-o", "out", "-q")
    assert ended(study) == (0, [])
    return numbers(folder / "out")


def test_members_of_a_killed_worker_go_on_elsewhere(
    engine: Engine, whole: dict[str, dict[str, list[float]]]
) -> None:
    """All are whole, and no process of Dask has loaded MPI or PETSc."""
    (engine.folder / "once.py").write_text(KILLED_ONCE)
    words = "--with once.py --set output.checkpoint=20 -o out -q".split()
    assert ended(engine.study(*words)) == (0, [])
    dask = [p.pid for p in (*engine.workers, engine.scheduler) if p.poll() is None]
    assert len(dask) == 2
    assert not [n for n in dask if "libmpi" in Path(f"/proc/{n}/maps").read_text()]
    log = engine.folder / "out" / "loads.force.value-5" / "run.log"
    assert "resumes from the checkpoint" in log.read_text()
    assert numbers(engine.folder / "out") == whole and not engine.at_work()


@pytest.mark.parametrize(("number", "code"), [("SIGUSR1", 4), ("SIGTERM", 143), ("SIGKILL", -9)])
def test_a_stopped_study_leaves_nothing_behind(
    number: str, code: int, shared: Engine, whole: dict[str, dict[str, list[float]]]
) -> None:
    """And goes on, with a scheduler or without one."""
    study = shared.study("-o", "out", "-q")
    shared.wait_for_steps(study)
    at_work = shared.at_work()
    study.send_signal(getattr(signal, number))
    assert ended(study)[0] == code and at_work and all(map(has_ended, at_work))
    assert not shared.at_work()
    assert are_stopped(numbers(shared.folder / "out"))
    again = shared.study if number == "SIGKILL" else shared.alone
    assert ended(again("-o", "out", "-q")) == (0, [])
    assert numbers(shared.folder / "out") == whole


def test_a_signal_reaches_the_members_of_one_study(
    shared: Engine, whole: dict[str, dict[str, list[float]]]
) -> None:
    """Another one at the same scheduler goes on."""
    first, second = (shared.study("-o", out, "-q", "--jobs", "1") for out in ("one", "two"))
    shared.wait_for_steps(first, "one")
    shared.wait_for_steps(second, "two")
    first.send_signal(signal.SIGUSR1)
    assert ended(first)[0] == 4 and second.poll() is None
    assert are_stopped(numbers(shared.folder / "one"))
    assert ended(second) == (0, [])
    assert numbers(shared.folder / "two") == whole


def test_without_workers_or_scheduler_it_ends_with_a_line(engine: Engine) -> None:
    """The command that waits for workers is told, and so is one whose scheduler is killed."""
    study = engine.study("-o", "out", "-q")
    engine.wait_for_steps(study)
    at_work = engine.at_work()
    engine.scheduler.kill()
    code, (line,) = ended(study)
    assert code == 5 and f"--scheduler {engine.file}: is lost; all recorded" in line
    assert all(map(has_ended, at_work))


def test_no_workers(tmp_path: Path) -> None:
    engine = Engine(tmp_path)
    code, (line,) = ended(engine.study("-o", "out", "-q", seconds=1.0))
    engine.scheduler.kill()
    assert code == 5 and f"--scheduler {engine.file}: has no workers; " in line


def test_a_worker_with_other_sources_is_refused(engine: Engine) -> None:
    """Before the first member."""
    copy = engine.folder / "edited" / "remodel_fenicsx"
    shutil.copytree(PROJECT / "remodel_fenicsx", copy)
    (copy / "errors.py").write_text((copy / "errors.py").read_text() + "NEW = 1\n")
    engine.add_workers(1, PYTHONPATH=str(copy.parent))
    while (engine.folder / "worker.log").read_text().count("Registered to") < 3:
        time.sleep(0.05)
    code, (line,) = ended(engine.study("-o", "out", "-q"))
    assert code == 5 and "has another remodel_fenicsx; start it again" in line
    assert not list((engine.folder / "out").glob("*/history.csv"))


def test_extensions_reach_the_workers(shared: Engine) -> None:
    (shared.folder / "mine.py").write_text(DRIVER)
    words = "--set remodeling.driver=mine --with mine.py --set time.end=2 -o out -q".split()
    assert ended(shared.study(*words)) == (0, [])
    assert "mine.py sha256" in next((shared.folder / "out").glob("*/scene.toml")).read_text()


def test_a_member_that_kills_its_workers_is_given_up(engine: Engine) -> None:
    """The others are the answer."""
    killer = engine.folder / "killer.py"
    killer.write_text(KILLER)
    engine.add_workers(3)
    study = engine.study("--with", str(killer), "--set", "time.end=2", "-o", "out", "-q")
    code, lines = ended(study)
    assert code == 3 and lines == [
        "remodel-fenicsx: loads.force.value-5 has failed: killed its worker 4 times"
    ]
