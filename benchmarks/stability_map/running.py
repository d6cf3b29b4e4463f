"""Cases to records, of the map and of random scenes: scenes run by the command line, many in one process."""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import importlib
import io
import json
import math
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time as clock
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from unittest.mock import patch

import numpy as np
import tomlkit

from benchmarks.stability_map.cases import Case, Run
from benchmarks.stability_map.judging import CRASHED, NO_END, judged
from remodel_fenicsx import Recording
from remodel_fenicsx._version import __version__

PROJECT = Path(__file__).resolve().parents[2]
WANTED_FIELDS = (
    "deformation_gradient",
    "cauchy_stress",
    "cell_dimensions",
    "axis_1",
    "axis_2",
    "axis_3",
)
Record = dict[str, Any]


# ---------------------------------------------------------------- one scene, in the process that runs scenes
def run_request(request: dict[str, Any]) -> Run:
    """Run one scene as a user does.

    Parameters
    ----------
    request
        `scene`: nested tables; `counts`: {module: {constant: value}}, numbers of elements that scenes cannot ask for;
        `extended`: whether it needs the loads and bodies of `extensions`.
        Ways to run it that must change nothing: `ranks`; `stop`, a time at which it ends and is resumed; `recorded`:
        the scene.toml that it leaves is what is run.
    """
    if request.get("extended"):
        importlib.import_module("benchmarks.stability_map.extensions").register()
    start, said = clock.perf_counter(), io.StringIO()
    with tempfile.TemporaryDirectory(prefix="remodel-fenicsx-stability-") as name:
        folder = Path(name)
        scene, results = folder / "scene.toml", folder / "run"
        tables = {
            "model": {"kinematics": "full"},
            **request["scene"],
        }  # without it they take the cheapest kinematics
        scene.write_text(tomlkit.dumps(tables), encoding="utf-8")
        command = ["run", str(scene), "-o", str(results), "-q"]
        with (
            element_counts(request.get("counts", {})), contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(io.StringIO()),
        ):  # fmt: skip
            if "ranks" in request:
                code = on_ranks(request, command, said)
            elif "stop" in request:
                code = commanded([*command, "--set", f"time.end={request['stop']!r}"], said)
                if code == 0:
                    end = f"time.end={tables['time']['end']!r}"
                    code = commanded(["run", "--resume", str(results), "--set", end, "-q"], said)
            else:
                code = commanded(command, said)
            if code == 0 and request.get("recorded"):
                recorded, results = results / "scene.toml", folder / "again"
                code = commanded(["run", str(recorded), "-o", str(results), "-q"], said)
        return Run(
            code, said.getvalue()[-2000:], clock.perf_counter() - start, **read_results(results)
        )


def commanded(command: list[str], said: io.StringIO) -> Any:
    """The exit code of a command line in this process."""
    try:
        return importlib.import_module("remodel_fenicsx.cli").main(command)
    except SystemExit as error:  # the command line's own words for its arguments
        return error.code
    except Exception:  # a defect of the program is an outcome of the map, with its traceback
        said.write(traceback.format_exc())
        return 1


ON_RANKS = """import json, sys
from benchmarks.stability_map.running import element_counts
from remodel_fenicsx.cli import main
with element_counts(json.loads(sys.argv[1])):
    code = main(sys.argv[2:])
sys.exit(code)
"""


def on_ranks(request: dict[str, Any], command: list[str], said: io.StringIO) -> int:
    """The exit code of a command line in processes of its own, each with the request's numbers of elements."""
    words = [
        "mpirun",
        "--allow-run-as-root",
        "--oversubscribe",
        "-n",
        str(request["ranks"]),
        sys.executable,
        "-c",
    ]
    words += [ON_RANKS, json.dumps(request.get("counts", {})), *command]
    environment = os.environ | {"PYTHONPATH": str(PROJECT)}
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        timeout=300,
        cwd=tempfile.gettempdir(),
        env=environment,
    )
    said.write(done.stderr)
    return done.returncode


@contextlib.contextmanager
def element_counts(counts: dict[str, dict[str, Any]]) -> Iterator[None]:
    """Numbers of elements other than the paper's, where meshes are made."""
    with contextlib.ExitStack() as stack:
        for name, constants in counts.items():
            values = {
                key: tuple(value) if isinstance(value, list) else value
                for key, value in constants.items()
            }
            stack.enter_context(patch.multiple(f"remodel_fenicsx.body.{name}", **values))
        yield


def read_results(folder: Path) -> dict[str, Any]:
    """Warnings, history and last fields of a run's folder, as far as it came."""
    found: dict[str, Any] = {"warnings": [], "history": {}, "fields": {}}
    if (folder / "run.log").exists():
        lines = (folder / "run.log").read_text(encoding="utf-8").splitlines()
        found["warnings"] = [
            re.sub(r"^.*? WARNING ", "", line) for line in lines if " WARNING " in line
        ]
    if (folder / "history.csv").exists():
        with (folder / "history.csv").open(encoding="utf-8") as file:
            rows = csv.DictReader(file)
            values = [[value_of(entry) for entry in row.values()] for row in rows]
        names = rows.fieldnames or []
        found["history"] = {name: [row[i] for row in values] for i, name in enumerate(names)}
    if (folder / "fields.vtkhdf").exists():
        recording = Recording(folder)
        last = recording.times[-1:]
        found["fields"] = recording.fields(last[0], WANTED_FIELDS) if len(last) else {}
        found["fields"]["time"] = float(last[0]) if len(last) else None
    return found


def value_of(entry: str) -> float:
    """An entry of history.csv: empty is nan, and what says nan is none that a row may have."""
    return float("nan") if not entry else float("inf") if math.isnan(float(entry)) else float(entry)


# ---------------------------------------------------------------- who asks for it
class Runner:
    """A process that runs scenes.

    Parameters
    ----------
    limit
        Seconds of processor time that one scene may take; then the process is ended and another one started.
    """

    def __init__(self, limit: float):
        self.limit = limit
        self._process: Any = None

    def run(self, request: dict[str, Any]) -> Run:
        """One scene; `CRASHED` or `NO_END` with words where there is no answer."""
        if self._process is None:
            os.environ["OMP_NUM_THREADS"] = "1"
            started = multiprocessing.get_context("spawn")
            self._pipe, other = started.Pipe()
            self._process = started.Process(target=serve, args=(other,), daemon=True)
            self._process.start()
            other.close()
        end = processor_seconds(self._process.pid) + self.limit
        try:
            self._pipe.send(request)
            while not self._pipe.poll(0.5):
                if processor_seconds(self._process.pid) > end:
                    self.close()
                    return Run(NO_END, f"no end within {self.limit:g} s", self.limit)
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode
            self.close()
            return Run(CRASHED, f"the program has crashed ({code})", self.limit)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def serve(pipe: Any) -> None:
    """Answer requests until there are no more; what libraries print goes nowhere."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(run_request(pipe.recv()))


def processor_seconds(process: int) -> float:
    """Processor time that a process has used: other work on the machine does not count."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:  # it has crashed, and its pipe is about to say so
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


# ---------------------------------------------------------------- a case to its record
def evaluated(case: Case, runner: Runner, source: str) -> Record:
    """Run a case and its companion, judge it."""
    start = clock.perf_counter()
    request = {"scene": case.scene, "counts": case.counts, "extended": case.extended}
    run = runner.run(request)
    if case.companion is not None and run.code == 0:
        run.companion = runner.run({**request, "scene": case.companion})
    verdict = judged(case, run)
    no_end = NO_END in (run.code, run.companion.code if run.companion else None)
    return {
        "key": case.key, "family": case.family, "source": source, "digest": digest(case), **asdict(verdict),
        "reference": case.reference, "warnings": len(run.warnings), "seconds": round(run.seconds, 2),
        "total": round(clock.perf_counter() - start, 2), **({"no_end_within": runner.limit} if no_end else {}),
    }  # fmt: skip


def plain(value: Any) -> Any:
    """What json does not know: numbers of numpy."""
    return value.item() if isinstance(value, np.generic) else str(value)


def digest(case: Case) -> str:
    """Of everything that makes its result, references included: what changes is judged again."""
    scenes = [
        case.scene,
        case.companion,
        dict(case.counts),
        dict(case.options),
        case.check.__name__,
    ]
    text = json.dumps(scenes, sort_keys=True, default=plain) + judges("stability_map")
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@lru_cache
def judges(*rooms: str) -> str:
    """Hash of what makes scenes and judges them."""
    files = sorted(PROJECT.glob("tests/reference/*.py"))
    files += [path for room in rooms for path in sorted(PROJECT.glob(f"benchmarks/{room}/*.py"))]
    apart = ("command", "report", "running")
    return hashlib.sha256(
        b"".join(path.read_bytes() for path in files if path.stem not in apart)
    ).hexdigest()


def source_of() -> str:
    """Version and hash of the package."""
    package, key = PROJECT / "remodel_fenicsx", hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        key.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    return f"{__version__}+{key.hexdigest()[:10]}"


# ---------------------------------------------------------------- many of them
def parser_of(description: str | None, limit: float, results: str) -> argparse.ArgumentParser:
    """The options that both commands have; seconds and the name of the results' folder are their defaults."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--again", action="store_true", help="run also what has been measured")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="at a time (all cores)"
    )
    words = f"of processor time for one scene ({limit:g})"
    parser.add_argument("--limit", type=float, default=limit, metavar="SECONDS", help=words)
    parser.add_argument(
        "--results", type=Path, default=PROJECT / "results" / results, help="folder of the results"
    )
    return parser


def measure(
    jobs: Mapping[Any, Callable[[Runner], Record]], said: Callable[[Record], str], source: str,
    options: argparse.Namespace,
) -> dict[Any, Record]:  # fmt: skip
    """Do jobs, several at a time; each record is a line of the file of the version as soon as it is there."""
    found: dict[Any, Record] = {}
    options.results.mkdir(parents=True, exist_ok=True)
    start = clock.monotonic()
    runners, free = [Runner(options.limit) for _ in range(options.jobs)], SimpleQueue[Runner]()
    for runner in runners:
        free.put(runner)

    def done(job: Callable[[Runner], Record]) -> Record:
        runner = free.get()
        try:
            return job(runner)
        finally:
            free.put(runner)

    with (
        file_of(options, source).open("a", encoding="utf-8") as out,
        ThreadPoolExecutor(options.jobs) as pool,
    ):
        waiting = {pool.submit(done, job): key for key, job in jobs.items()}
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                record = found[waiting[future]] = future.result()
                out.write(json.dumps(record) + "\n")
                out.flush()
                left = (clock.monotonic() - start) / number * (len(jobs) - number)
                print(
                    f"[{number}/{len(jobs)}, {left / 60:.0f} min left] {said(record)}",
                    file=sys.stderr,
                    flush=True,
                )
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            print(
                "stopped; what has been measured is kept, the same command goes on", file=sys.stderr
            )
    for runner in runners:
        runner.close()
    return found


def file_of(options: argparse.Namespace, source: str) -> Path:
    """Of the results of a version."""
    return Path(options.results / f"{source.partition('+')[0]}.jsonl")


def read_records(file: Path) -> list[Record]:
    """All lines of a file of results; one that was cut off at the end is left out."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]
