"""What a command writes is there whole or not at all, whenever it is killed; and it goes on where one was killed."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from remodel_fenicsx import cli, preset_scene, run as run_scene
from remodel_fenicsx.system.files import write_new
from tests.conftest import Refused
from tests.processes import ran

# a command that is killed at its N-th write, rename or link that has to do with a file of this name
KILLED = """
import os, signal, sys
from remodel_fenicsx import cli
left = [int(sys.argv[1])]
def watch(event, arguments):
    if event in ("open", "os.rename", "os.link", "os.mkdir") and sys.argv[2] in str(arguments[0]):
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(watch)
sys.exit(cli.main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def quarter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a quarter of a tube."""
    changes = {
        "model.kinematics": "sector",
        "mesh.refinement": 1,
        "time.end": 1.0,
        "cells.initial": "isotropic",
    }
    return run_scene(
        preset_scene("kuhl-holzapfel-2007", "tube").with_values(changes),
        tmp_path_factory.mktemp("q") / "run",
    )


def test_revolve_that_was_killed_does_not_block_itself(quarter: Path) -> None:
    names = ["fields_body.vtkhdf", "fields_body_chains.vtkhdf"]
    command = [
        sys.executable,
        "-c",
        KILLED,
        "1",
        "fields_body.vtkhdf.part",
        "revolve",
        str(quarter),
    ]
    done = ran(command)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not any((quarter / name).exists() for name in names)
    assert cli.main(["revolve", str(quarter)]) == 0
    assert all((quarter / name).exists() for name in names)
    assert not list(quarter.glob("*.part"))


def test_revolve_of_damaged_fields_leaves_nothing(
    quarter: Path, tmp_path: Path, refused: Refused
) -> None:
    folder = shutil.copytree(
        quarter, tmp_path / "run", ignore=shutil.ignore_patterns("fields_body*")
    )
    with h5py.File(folder / "fields.vtkhdf") as file:
        chunk = file["VTKHDF/CellData/fibre_angle"].id.get_chunk_info(1)
    data = bytearray((folder / "fields.vtkhdf").read_bytes())
    data[chunk.byte_offset + 8] ^= 1
    (folder / "fields.vtkhdf").write_bytes(data)
    before = sorted(path.name for path in folder.iterdir())
    assert "fields.vtkhdf: is corrupt" in refused("revolve", folder)
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_new_file_is_whole_or_not_there(tmp_path: Path) -> None:
    """Killed before its name is given, and when it is there already."""
    path = tmp_path / "page.html"
    program = "import os; from pathlib import Path; from remodel_fenicsx.system import files\n"
    program += f"os.link = lambda *_: os.kill(os.getpid(), 9)\nfiles.write_new(Path({str(path)!r}), b'x' * 10**6)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == -signal.SIGKILL
    assert not path.exists()
    write_new(path, b"whole")
    with pytest.raises(FileExistsError):
        write_new(path, b"another")
    assert path.read_bytes() == b"whole" and [found.name for found in tmp_path.iterdir()] == [
        "page.html"
    ]
