"""Tutorials and how-to pages: each command and each file of a page, in its order, with short times.

What is said to be left out: pictures (a window of their own, tested elsewhere). Blocks of `text` are no commands.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from remodel_fenicsx import cli

ROOT = Path(__file__).parents[2]
TUBE = "tutorial_tube"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"# (\w+\.(?:toml|py))\n")
SHORT = {  # a test's times for those of the page
    "end = 100.0": "end = 2.0",
    "time.end=120": "time.end=3",
    "time.end=300": "time.end=2",
    "demos/artery.toml -o artery": "demos/artery.toml -o artery --set time.end=1",
    "demos/layers.toml -o": "demos/layers.toml --set time.end=2 -o",
    "run bent.toml": "run bent.toml --set time.end=1",
    "inflation.toml -o": "inflation.toml --starts 1 -o",
    "=8:16:3": "=8:16:2",
}
PAGES = sorted(page.stem for kind in ("tutorial", "howto") for page in (ROOT / "docs").glob(f"{kind}_*.md"))
LEFT_BEHIND = {
    "tutorial_artery": ["artery/history.csv"],
    "tutorial_tube": ["high/report.html"],
    "tutorial_layers": ["layers/report.html", "bent-axes.vtu", "bent/history.csv"],
    "tutorial_residual_stress": ["with/history.csv"],
    "tutorial_fit": ["fitted/fit.csv", "fitted/fit.png"],
    "tutorial_sweep": ["sweep/sweep.csv", "at-16/history.csv"],
    "howto_accuracy": ["fast/history.csv"],
    "howto_container": [],
    "howto_export": ["fibres.feb", "fibres.inp", "fibres.vtu", "fibres.csv"],
    "howto_extend": ["driven/history.csv"],
    "howto_paraview": ["tube/fields_body.vtkhdf"],
    "howto_ranks": ["ranks/history.csv"],
    "howto_resume": ["tube/history.csv"],
}


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each block, with short times."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    for long, short in SHORT.items():
        text = text.replace(long, short)
    return BLOCK.findall(text)


def keep(text: str) -> bool:
    """Write the block into the file that its first line names; whether it names one."""
    name = NAMED.match(text)
    if name is not None:
        Path(name[1]).write_text(text, encoding="utf-8")
    return name is not None


def obey(line: str) -> None:
    """One command of a page."""
    program, *words = shlex.split(line.removeprefix("./with-fenicsx "))
    words = [str(ROOT / word) if word.startswith("demos/") else word for word in words]
    if program == "remodel-fenicsx":
        if words[0] != "picture":
            assert cli.main(words) == 0, line
    elif program == "cp":
        shutil.copy(*words)
    else:
        assert program in ("python3", "mpirun"), line
        command = [sys.executable if program == "python3" else program, *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=200)
        assert done.returncode == 0, line + "\n" + done.stderr[-1000:]


@pytest.mark.parametrize("page", PAGES)
def test_a_reader_gets_through_the_page(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    if page != TUBE:
        for _, text in blocks(TUBE):
            keep(text)
    for language, text in blocks(page):
        if language == "sh":
            for line in text.splitlines():
                obey(line)
        elif language in ("python", "toml"):
            assert keep(text), f"a block that no file takes: {text[:60]}"
    for name in LEFT_BEHIND[page]:
        assert Path(name).stat().st_size > 0, name


def test_what_is_said_to_be_shortened_is_there() -> None:
    text = "".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8") for page in PAGES)
    assert all(long in text for long in SHORT)
