"""Cases to records, of the map and of random scenes: each process that judges owns one that runs scenes."""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import multiprocessing
import os
import select
import subprocess
import sys
import tempfile
import time as clock
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import Case, Run, all_cases
from benchmarks.stability_map.judging import CRASHED, NO_END, judged
from remodel_fenicsx._version import __version__

PROJECT = Path(__file__).resolve().parents[2]
RUNNER = Path(__file__).with_name("runner.py")
Record = dict[str, Any]
ENDED = (0, 1, 2, 3)  # a run that was killed, or went on for too long, may end otherwise another time


class Runner:
    """A process that runs scenes.

    Parameters
    ----------
    store
        Folder that keeps what came out of a scene, so that a new reference runs nothing again.
    limit
        Seconds of processor time that one scene may take; then the process is ended and another one started.
    """

    def __init__(self, limit: float, store: Path | None = None):
        self.limit, self.store = limit, store
        self._process: subprocess.Popen[str] | None = None

    def run(self, request: dict[str, Any]) -> Run:
        """One scene, from the store if it is there."""
        if self.store is None:
            return self._run(request)
        text = json.dumps(request, sort_keys=True, default=plain)
        kept = self.store / f"{hashlib.sha256(text.encode()).hexdigest()[:20]}.json.gz"
        if kept.exists():
            return Run(**json.loads(gzip.decompress(kept.read_bytes())))
        run = self._run(request)
        if run.code in ENDED:
            self.store.mkdir(parents=True, exist_ok=True)
            part = kept.with_suffix(f".{os.getpid()}")
            part.write_bytes(gzip.compress(json.dumps(asdict(run)).encode()))
            part.rename(kept)
        return run

    def _run(self, request: dict[str, Any]) -> Run:
        """One scene; `CRASHED` or `NO_END` with words where there is no answer."""
        process = self._process = self._process or self._started()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(request, default=plain) + "\n")
            process.stdin.flush()
            end = processor_seconds(process.pid) + self.limit
            while not (ready := select.select([process.stdout], [], [], 0.5)[0]):
                if processor_seconds(process.pid) > end:
                    break
            line = process.stdout.readline() if ready else ""
        except BrokenPipeError:
            ready, line = [process], ""
        if not line:
            self.close()
            why = f"the program has crashed ({process.returncode})" if ready else f"no end within {self.limit:g} s"
            return Run(CRASHED if ready else NO_END, why, self.limit)
        return Run(**json.loads(line))

    def _started(self) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": str(PROJECT), "OMP_NUM_THREADS": "1"}
        log = tempfile.TemporaryFile("w")
        return subprocess.Popen(
            [sys.executable, str(RUNNER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
            env=environment, cwd=tempfile.gettempdir(),
        )  # fmt: skip

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def processor_seconds(process: int) -> float:
    """Processor time that a process has used: other work on the machine does not count."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:  # it has crashed, and its pipe is about to say so
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


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
    scenes = [case.scene, case.companion, dict(case.counts), dict(case.options), case.check.__name__]
    text = json.dumps(scenes, sort_keys=True, default=plain) + references()
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@lru_cache
def references() -> str:
    """Hash of what judges."""
    files = [PROJECT / "tests" / "reference" / "radial.py"]
    files += [path for path in sorted(RUNNER.parent.glob("*.py")) if path.stem not in ("command", "report", "running")]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def source_of() -> str:
    """Version and hash of the package."""
    package, key = PROJECT / "remodel_fenicsx", hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        key.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    return f"{__version__}+{key.hexdigest()[:10]}"


# ---------------------------------------------------------------- many of them
_mine: dict[str, Any] = {}


def parser_of(description: str | None, limit: float, results: str) -> argparse.ArgumentParser:
    """The options that both commands have; seconds and the name of the results' folder are their defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="store_true", help="run also what has been measured")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="at a time (all cores)")
    parser.add_argument(
        "--limit", type=float, default=limit, metavar="SECONDS", help=f"of processor time for one scene ({limit:g})"
    )
    parser.add_argument("--results", type=Path, default=PROJECT / "results" / results, help="folder of the results")
    return parser


def measure(
    keys: Sequence[Any], evaluate: Callable[[Any], Record], said: Callable[[Record], str], source: str,
    options: argparse.Namespace,
) -> dict[Any, Record]:  # fmt: skip
    """Run and judge, in processes; each record is a line of the file of the version as soon as it is there."""
    found: dict[Any, Record] = {}
    if not keys:
        return found
    options.results.mkdir(parents=True, exist_ok=True)
    start, store = clock.monotonic(), None if options.again else options.results / "runs" / source.partition(" ")[0]
    with (
        file_of(options, source).open("a", encoding="utf-8") as out,
        ProcessPoolExecutor(
            options.jobs, multiprocessing.get_context("spawn"), _set_up, (options.limit, source, store)
        ) as pool,
    ):  # fmt: skip
        waiting = {pool.submit(evaluate, key): key for key in keys}
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                record = found[waiting[future]] = future.result()
                out.write(json.dumps(record) + "\n")
                out.flush()
                left = (clock.monotonic() - start) / number * (len(keys) - number)
                print(f"[{number}/{len(keys)}, {left / 60:.0f} min left] {said(record)}", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            print("stopped; what has been measured is kept, the same command goes on", file=sys.stderr)
    return found


def file_of(options: argparse.Namespace, source: str) -> Path:
    """Of the results of a version."""
    return Path(options.results / f"{source.partition('+')[0]}.jsonl")


def _set_up(limit: float, source: str, store: Path | None) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    _mine.update(runner=Runner(limit, store), source=source)


def mine() -> tuple[Runner, str]:
    """Of a process of the pool: what runs scenes there, and the source that its records name."""
    return _mine["runner"], _mine["source"]


def evaluate(key: str) -> Record:
    """A case by its key, in a process of the pool."""
    return evaluated(_cases()[key], *mine())


_cases = lru_cache(all_cases)
