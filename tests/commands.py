"""Commands one after the other on this process group, for a start of ranks takes longer than most of them.

mpirun -n 2 python3 commands.py FOLDER: FOLDER/commands.json has words by name. Of each is left what all ranks said,
NAME.out and NAME.err, and in codes.json their exit codes; the last one may end all ranks. Tubes have few elements.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from mpi4py import MPI

import remodel_fenicsx.body.tube
from remodel_fenicsx import cli
from tests.forks import readers_are_forks


def main(folder: Path) -> None:
    """All of them; what they do not say goes to the streams that this process had at first."""
    readers_are_forks()
    remodel_fenicsx.body.tube.PAPER = (8, 4, 1)
    codes, own = {}, [os.dup(1), os.dup(2)]
    for name, words in json.loads((folder / "commands.json").read_text()).items():
        for number, ending in ((1, "out"), (2, "err")):
            os.dup2(
                os.open(folder / f"{name}.{ending}", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600),
                number,
            )
        code = cli.main(words)
        sys.stdout.flush()
        for number, stream in enumerate(own, 1):
            os.dup2(stream, number)
        codes[name] = MPI.COMM_WORLD.gather(code)
        if MPI.COMM_WORLD.rank == 0:
            (folder / "codes.json").write_text(json.dumps(codes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
