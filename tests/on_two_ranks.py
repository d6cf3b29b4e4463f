"""Runs on this process group that tests/results/test_resume.py looks at: mpirun -n 2 python3 on_two_ranks.py FOLDER.

FOLDER holds `half`, a run on one rank. Made are: `whole`, `resumed` (the same, stopped and gone on), what `half`
becomes on these ranks, `one element` (so that a rank has none), `codes.json` (exit codes of commands), and `lost`:
there the last rank is killed in a step.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

from remodel_fenicsx import cli
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.running import resume, run
from tests.results.test_resume import LOST_AT, scene


def main(folder: Path) -> None:
    """All of them, the killed one last."""
    comm = MPI.COMM_WORLD
    run(scene(), folder / "whole")
    run(scene(6.0), folder / "resumed")
    resume(folder / "resumed", ["time.end=9.0"])
    resume(folder / "half", ["time.end=8.0"])
    run(scene(2.0).with_values({"mesh.refinement": 1}), folder / "one element")
    words = ["run", "--resume", str(folder / "half"), "--set", "time.end=10", "-q"]
    codes = {"wall time": cli.main([*words, "--max-wall-time", "0.001s"])}
    if comm.rank == 0:
        (folder / "codes.json").write_text(json.dumps(codes))
    solve = Staggered.solve

    def killed(coupling: Staggered, time: float, loads: dict[str, float]) -> Any:
        if time == LOST_AT and comm.rank == comm.size - 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return solve(coupling, time, loads)

    Staggered.solve = killed  # type: ignore[method-assign]
    run(scene(checkpoint=2), folder / "lost")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
