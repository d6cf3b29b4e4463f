"""Runs scenes through the command line, many in one process, and returns what a user would see.

python3 runner.py       reads one request a line (JSON), answers with one line each
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time as clock
import traceback
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tomlkit

WANTED_FIELDS = ("deformation_gradient", "cauchy_stress", "cell_dimensions", "axis_1", "axis_2", "axis_3")


def run_request(request: dict[str, Any]) -> dict[str, Any]:
    """Run one scene.

    Parameters
    ----------
    request
        `scene`: nested tables; `counts`: {module: {constant: value}}, numbers of elements that scenes cannot ask for;
        `extended`: whether it needs the loads and bodies of `extensions`.
        Ways to run it that must change nothing: `ranks`; `stop`, a time at which it ends and is resumed; `recorded`:
        the scene.toml that it leaves is what is run.

    Returns
    -------
    `code`: exit code; `said`: standard error; `warnings`: lines
    of run.log; `history`: columns; `fields`: of the last recorded time; `seconds`.
    """
    if request.get("extended"):
        importlib.import_module("benchmarks.stability_map.extensions").register()
    start = clock.perf_counter()
    with tempfile.TemporaryDirectory(prefix="remodel-fenicsx-stability-") as folder:
        scene, results = Path(folder) / "scene.toml", Path(folder) / "run"
        tables = {"model": {"kinematics": "full"}, **request["scene"]}  # without it they take the cheapest kinematics
        scene.write_text(tomlkit.dumps(tables), encoding="utf-8")
        said, command = io.StringIO(), ["run", str(scene), "-o", str(results), "-q"]
        with element_counts(request.get("counts", {})), contextlib.redirect_stderr(said):
            with contextlib.redirect_stdout(io.StringIO()):
                if "ranks" in request:
                    code = on_ranks(request, command, said)
                elif "stop" in request:
                    code = commanded([*command, "--set", f"time.end={request['stop']!r}"], said)
                    if code == 0:
                        more = ["run", "--resume", str(results), "--set", f"time.end={tables['time']['end']!r}", "-q"]
                        code = commanded(more, said)
                else:
                    code = commanded(command, said)
                if code == 0 and request.get("recorded"):
                    again = Path(folder) / "again"
                    code, results = commanded(["run", str(results / "scene.toml"), "-o", str(again), "-q"], said), again
        found = {"code": code, "said": said.getvalue()[-2000:], "seconds": clock.perf_counter() - start}
        return {**found, **read_results(results)}


def commanded(command: list[str], said: io.StringIO) -> Any:
    """The exit code of a command line in this process."""
    try:
        return importlib.import_module("remodel_fenicsx.cli").main(command)
    except SystemExit as error:  # the command line's own words for its arguments
        return error.code
    except Exception:  # a defect of the program is an outcome of the map, with its traceback
        said.write(traceback.format_exc())
        return 1


def on_ranks(request: dict[str, Any], command: list[str], said: io.StringIO) -> int:
    """The exit code of a command line in processes of its own, each with the request's numbers of elements."""
    program = (
        "import json, sys\n"
        "from benchmarks.stability_map.runner import element_counts\nfrom remodel_fenicsx.cli import main\n"
        "with element_counts(json.loads(sys.argv[1])): code = main(sys.argv[2:])\nsys.exit(code)"
    )
    words = [
        "mpirun",
        "--allow-run-as-root",
        "--oversubscribe",
        "-n",
        str(request["ranks"]),
        sys.executable,
        "-c",
        program,
    ]
    words += [json.dumps(request.get("counts", {})), *command]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, cwd=tempfile.gettempdir())
    said.write(done.stderr)
    return done.returncode


def value_of(entry: str) -> float:
    """An entry of history.csv: empty is nan, and what says nan is none that a row may have."""
    return float("nan") if not entry else float("inf") if math.isnan(float(entry)) else float(entry)


@contextlib.contextmanager
def element_counts(counts: dict[str, dict[str, Any]]) -> Any:
    """Numbers of elements other than the paper's, where meshes are made."""
    before = []
    for name, constants in counts.items():
        module = importlib.import_module(f"remodel_fenicsx.body.{name}")
        for key, value in constants.items():
            before.append((module, key, getattr(module, key)))
            setattr(module, key, tuple(value) if isinstance(value, list) else value)
    try:
        yield
    finally:
        for module, key, value in before:
            setattr(module, key, value)


def read_results(folder: Path) -> dict[str, Any]:
    """Warnings, history and last fields of a run's folder, as far as it came."""
    found: dict[str, Any] = {"warnings": [], "history": {}, "fields": {}}
    if (folder / "run.log").exists():
        lines = (folder / "run.log").read_text(encoding="utf-8").splitlines()
        found["warnings"] = [re.sub(r"^.*? WARNING ", "", line) for line in lines if " WARNING " in line]
    if (folder / "history.csv").exists():
        names, *rows = (folder / "history.csv").read_text(encoding="utf-8").splitlines() or [""]
        values = [[value_of(entry) for entry in row.split(",")] for row in rows]
        found["history"] = {name: [row[i] for row in values] for i, name in enumerate(names.split(","))}
    if (folder / "fields.vtkhdf").exists():
        with h5py.File(folder / "fields.vtkhdf", "r") as file:
            root = file["VTKHDF"]
            last = int(root["Steps"].attrs["NSteps"]) - 1
            number = int(root["NumberOfCells"][0])
            for name in WANTED_FIELDS if last >= 0 else ():
                first = int(root["Steps"]["CellDataOffsets"][name][last])
                values = np.asarray(root["CellData"][name][first : first + number], dtype=np.float64)
                found["fields"][name] = values.reshape(number, -1).tolist()
            found["fields"]["time"] = float(root["Steps"]["Values"][last]) if last >= 0 else None
    return found


def main() -> None:
    """Answer requests until the input ends; what libraries print goes to the standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        answers.write(json.dumps(run_request(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
