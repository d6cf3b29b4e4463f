"""Runs of this very package in processes of their own, which end with the one that has started them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import remodel_fenicsx
from remodel_fenicsx.system.regular_files import open_own

PATIENCE = 30.0  # seconds


class Child:
    """A command of remodel-fenicsx in a process, which ends with this one, even if that is killed (with setpriv).

    Parameters
    ----------
    arguments
        Of the command line.
    messages
        File for all that it says.
    keep
        Descriptors that it inherits.
    """

    def __init__(self, arguments: Sequence[str], messages: Path, keep: Sequence[int] = ()):
        self.messages = messages
        command = [sys.executable, "-m", "remodel_fenicsx.cli", *arguments]
        if shutil.which("setpriv"):  # the signal comes from now on; who was killed before is not the parent any more
            only_with_parent = ["sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"', str(os.getpid())]
            command = ["setpriv", "--pdeathsig", signal.SIGTERM.name, *only_with_parent, *command]
        # this very package, wherever it was imported from; one thread each, as there are jobs for the cores
        paths = [str(Path(remodel_fenicsx.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        messages.unlink(missing_ok=True)  # whatever it is, a link too
        with open(open_own(messages, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w") as output:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                                            env=environment, pass_fds=tuple(keep))  # fmt: skip

    def last_words(self) -> str:
        """The last line that it has said."""
        said = self.messages.read_text(errors="replace").strip().splitlines()
        return said[-1].removeprefix("remodel-fenicsx: ") if said else "it said nothing"

    def stop(self) -> None:
        """End it, by force if it takes too long."""
        self.process.terminate()
        try:
            self.process.wait(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))
