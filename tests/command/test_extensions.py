"""Parts of one's own: --with and REMODEL_FENICSX_EXTENSIONS, for all commands, ranks and children."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pytest

from remodel_fenicsx.results.recording import read_history
from remodel_fenicsx.system.environment import EXTENSIONS
from tests.command.test_run import PROJECT, refusal_of, run
from tests.forks import forked
from tests.tables import of_csv, rows, unescaped

DEMO = PROJECT / "demos" / "extensions" / "shear_column.py"
DRIVER = """from remodel_fenicsx.extend import DRIVERS, Driver
DRIVERS["mine"] = Driver(lambda F, stresses: stresses.cauchy, material=False)
"""

WITHOUT_A_BODY = """import sys, numpy; from remodel_fenicsx import cli; from remodel_fenicsx import pictures as bodies
bodies.render = lambda job: [numpy.zeros((9, 9, 3), numpy.uint8)]; sys.exit(cli.main(sys.argv[1:]))"""
SCENE = """preset = "kuhl-holzapfel-2007"
geometry.shape = "cube"
model.kinematics = "point"
loads.force.value = 10.0
remodeling.driver = "mine"
time.end = 2.0
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a scene that names a driver of mine.py, which is there too."""
    (tmp_path / "cube.toml").write_text(SCENE)
    (tmp_path / "mine.py").write_text(DRIVER)
    return tmp_path


def test_the_demo_of_a_column(tmp_path: Path) -> None:
    """Of a cube that is pulled uniformly; both extensions of a line are run, in any place of it."""
    (tmp_path / "other.py").write_text("print('the other one')\n")
    words = [
        "--with",
        DEMO,
        "run",
        PROJECT / "demos" / "cube.toml",
        "-q",
        "-o",
        tmp_path / "run",
        "--set=time.end=2",
    ]
    done = run(*words, f"--with={tmp_path / 'other.py'}")
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("the other one\n")
    history = read_history(tmp_path / "run")
    assert history["max_shear_strain"][0] == 0.0 and history["max_shear_strain"][2] > 0.05
    across = np.sqrt(history["min_jacobian"] / history["mean_stretch"])
    strain = (history["mean_stretch"] ** 2 - across**2) / 2
    np.testing.assert_allclose(history["max_shear_strain"], strain, rtol=1e-6, atol=1e-12)
    header = (tmp_path / "run" / "scene.toml").read_text().split("\n\n")[0]
    for path in (DEMO, tmp_path / "other.py"):
        assert (
            f"# {path.name} sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"
            in f"{header}\n"
        )
    assert len(DEMO.read_text().splitlines()) < 60


def test_every_command_knows_it(place: Path) -> None:
    """By the option or the variable; without it a scene that needs it is refused."""
    assert "remodeling.driver = 'mine'" in refusal_of("validate", "cube.toml", cwd=place)
    variables = {**os.environ, EXTENSIONS: str(place / "mine.py")}
    assert (
        forked(
            "remodel-fenicsx", "validate", "cube.toml", cwd=place, variables=variables
        ).returncode
        == 0
    )
    for words in (
        "validate cube.toml",
        "run cube.toml -q -o run",
        "report run",
        "picture run -o run.png",
        "info",
    ):
        program = ["python", WITHOUT_A_BODY] if words.startswith("picture") else ["remodel-fenicsx"]
        done = forked(*program, *words.split(), "--with", "mine.py", cwd=place)
        assert (done.returncode, done.stderr) == (0, ""), words
    assert "mine.py" in (place / "run" / "report.html").read_text()
    assert "mine.py" in refusal_of("report", "run", cwd=place)


def test_the_runs_of_a_study_know_it(place: Path) -> None:
    """They are processes of their own, in folders of their own."""
    words = "sweep cube.toml loads.force.value=5:10:2 --jobs 1 -q -o sweep --with mine.py"
    done = run(*words.split(), "--with", DEMO, cwd=place)
    assert done.returncode == 0, done.stderr
    strains = [float(row["max_shear_strain"]) for row in of_csv(place / "sweep" / "sweep.csv")]
    assert len(strains) == 2 and min(strains) > 0.01


def test_both_ranks_know_it(place: Path) -> None:
    done = run("run", "cube.toml", "--with", "mine.py", "-q", "-o", "run", ranks=2, cwd=place)
    assert done.returncode == 0, done.stderr


def test_a_run_goes_on_with_it(place: Path) -> None:
    assert (
        run("run", "cube.toml", "--with", "mine.py", "-q", "-o", "run", cwd=place).returncode == 0
    )
    before = (place / "run" / "scene.toml").read_bytes()
    assert "extension mine.py" in refusal_of(
        "run", "--resume", "run", "--set=time.end=3", cwd=place
    )
    assert (place / "run" / "scene.toml").read_bytes() == before
    (place / "mine.py").write_text(f"{DRIVER}\n")
    other = run("--with", "mine.py", "run", "--resume", "run", "--set=time.end=3", "-q", cwd=place)
    assert other.returncode == 0 and re.search(
        r"resumes with mine.py sha256:\w+, but was started with", other.stderr
    )
    assert list(read_history(place / "run")["time"]) == [0.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("text", "said"), [("", "No such file"), *rows(__file__, "bad_parts.txt")])
def test_a_file_that_cannot_be_run_is_bad_input(text: str, said: str, tmp_path: Path) -> None:
    if text:
        (tmp_path / "bad.py").write_text(unescaped(text))
    line = refusal_of("run", PROJECT / "demos" / "cube.toml", "--with", "bad.py", cwd=tmp_path)
    assert "bad.py" in line and said in line
    assert not (tmp_path / "results").exists()


COLUMN = "from remodel_fenicsx.extend import COLUMNS, Column\nCOLUMNS['a'] = Column({!r}, '', 'a', lambda m: {})\n"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("time", "7.0", "time: two columns have this name"),
        ("a\nb", "7.0", "bad.py, line 2: ValueError: column 'a\\nb'"),
        ("mine", "float('inf')", "the column 'mine' is inf at time 0"),
        ("mine", "1 / m.step.time", "bad.py, line 2: ZeroDivisionError"),
    ],
)
def test_a_column_that_cannot_be_written_is_refused_by_name(
    tmp_path: Path, name: str, value: str, said: str
) -> None:
    """In one line: a row that it would spoil is not there."""
    (tmp_path / "bad.py").write_text(COLUMN.format(name, value))
    line = refusal_of(
        "run", PROJECT / "demos" / "cube.toml", "--with", "bad.py", "-q", "-o", "run", cwd=tmp_path
    )
    assert said in line
    assert not (tmp_path / "run" / "history.csv").exists() or not len(
        read_history(tmp_path / "run")["time"]
    )


def test_two_of_one_name_are_refused_and_one_is_run_once(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text("print('hello')\n")
    done = run("info", "--with", "a/mine.py", "--with", "./a/mine.py", cwd=tmp_path)
    assert (
        done.returncode == 0
        and done.stdout.count("hello") == 1
        and "mine.py          sha256:" in done.stdout
    )
    assert "b/mine.py" in refusal_of(
        "info", "--with", "a/mine.py", "--with", "b/mine.py", cwd=tmp_path
    )
