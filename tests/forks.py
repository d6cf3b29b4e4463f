"""Runs of a tube of four layers. `python3 forks.py WORDS` is remodel-fenicsx WORDS with that tube.

Without words each line on stdin is JSON, [seconds, WORDS]: the command in a child of this process, which has imported
all that takes time; after these seconds of processor time it is killed, null: never. The answer is a line with its exit
status, negative for a signal.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import gmsh

from remodel_fenicsx import cli, running

assert gmsh and running  # imported here, not by each child
sys.modules["remodel_fenicsx.body.tube"].PAPER = (8, 4, 1)  # type: ignore[attr-defined]  # around, through, along


def status_of(words: list[str], seconds: float | None) -> int:
    """Exit status of a command, killed when it has worked for so long, however busy the machine is."""
    child = os.fork()
    if not child:
        os._exit(cli.main(words))
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if seconds is not None and int(Path(f"/proc/{child}/schedstat").read_text().split()[0]) > 1e9 * seconds:
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        time.sleep(0.002)


if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(cli.main(sys.argv[1:]))
    for line in sys.stdin:
        limit, command = json.loads(line)
        print(status_of(command, limit), flush=True)
