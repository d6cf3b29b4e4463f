"""What a command does with closed streams, long messages and options that PETSc refuses in the first solve."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.command.test_run import refusal_of, run
from tests.parts import pulled_cube


def test_a_closed_output_is_like_one_that_nobody_reads(tmp_path: Path) -> None:
    """And no file of the run gets its number."""
    (tmp_path / "cube.toml").write_text(pulled_cube(1.0).to_toml())
    command = f"{sys.executable} -P -m remodel_fenicsx.cli"
    for words in (f"run {tmp_path}/cube.toml -o {tmp_path}/run", f"status {tmp_path}/run"):
        done = subprocess.run(
            f"{command} {words} <&- >&-", shell=True, capture_output=True, text=True
        )
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.parametrize("option", ["mat_mumps_icntl_7=99", "snes_type=nasm"])
def test_an_option_that_petsc_refuses_late_is_bad_input(option: str, tmp_path: Path) -> None:
    (tmp_path / "cube.toml").write_text(pulled_cube(1.0).to_toml())
    direct = ["--set", "model.kinematics=full", "--set", "solver.method=direct"]
    words = [*direct, "--set", f"solver.petsc_options.{option}"]
    line = refusal_of("run", tmp_path / "cube.toml", "-q", "-o", tmp_path / "run", *words)
    assert "solver.petsc_options = " in line and option.split("=")[0] in line


def test_messages_are_short(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(f"[geometry]\nshape = 'cube'\n[time]\nend = 1.0\n{'k' * 20000} = 1\n")
    for words in (["validate", path], ["status", "x" * 20000], ["y" * 20000]):
        done = run(*words)
        assert done.returncode == 2 and len(done.stderr.splitlines()[-1]) < 950
