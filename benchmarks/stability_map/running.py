"""Cases to records: each process that judges owns one that runs scenes with the package of a checkout."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time as clock
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import Case, Run, all_cases
from benchmarks.stability_map.judging import CRASHED, NO_END, judged

PROJECT = Path(__file__).resolve().parents[2]
RUNNER = Path(__file__).with_name("runner.py")
Record = dict[str, Any]
ENDED = (0, 1, 2, 3)  # a run that was killed, or went on for too long, may end otherwise another time


class Runner:
    """A process that runs scenes with the package of a checkout.

    Parameters
    ----------
    checkout
        Folder with `remodel_fenicsx`.
    store
        Folder that keeps what came out of a scene, so that a new reference runs nothing again.
    limit
        Seconds of processor time that one scene may take; then the process is ended and another one started.
    """

    def __init__(self, checkout: Path, limit: float, store: Path | None = None):
        self.checkout, self.limit, self.store = checkout, limit, store
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
        if run.code in (None, *ENDED):
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
            process.stdin.write(json.dumps({**request, "other": self.checkout != PROJECT}, default=plain) + "\n")
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
        paths = os.pathsep.join(map(str, dict.fromkeys([self.checkout, PROJECT])))
        environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
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


def source_of(checkout: Path) -> str:
    """Version and hash of a checkout's package."""
    package, key = checkout / "remodel_fenicsx", hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        key.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    places = (package / "_version.py", package / "__init__.py")  # the latter in earlier versions
    text = next(place for place in places if place.exists()).read_text(encoding="utf-8")
    version = text.partition('__version__ = "')[2].partition('"')[0]
    return f"{version}+{key.hexdigest()[:10]}"


# ---------------------------------------------------------------- in a pool
_mine: dict[str, Any] = {}


def set_up(checkout: str, limit: float, source: str, store: str) -> None:
    """Of a process of the pool."""
    os.environ["OMP_NUM_THREADS"] = "1"
    _mine.update(
        runner=Runner(Path(checkout), limit, Path(store) / source if store else None), source=source, cases=all_cases()
    )


def evaluate(key: str) -> Record:
    """A case by its key, in a process of the pool."""
    return evaluated(_mine["cases"][key], _mine["runner"], _mine["source"])
