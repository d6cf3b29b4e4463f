"""Outputs and pictures of start, the tutorials, fit and howto_ranks: the pages are run as they stand.

About five minutes for all. A block of `output` after a command shows some of its lines, `...` stands for others; their
numbers are replaced by those of the run. A line that the command does not print ends the script: the page is then to be
changed by hand. tests/command/test_pages.py does the same with short times, and compares all but the numbers.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from docs.making.pages import save_small

DOCS = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"# (\w+\.(?:toml|py|csv))\n")
NUMBER = re.compile(r"(?<![\w.])-?\d[\d.,:]*(?:e[+-]?\d+)?(?!\w)")
PICTURES = {  # of docs/figures: what a page's commands leave
    "tutorial-artery.png": "artery.png",
    "tutorial-tube.png": "tube.png",
    "tutorial-layers.png": "layers.png",
    "tutorial-bent.png": "bent.png",
    "tutorial-residual-stress.png": "angles.png",
    "tutorial-carotid.png": "carotid.png",
    "tutorial-fit.png": "fitted/fit.png",
    "tutorial-biaxial.png": "biaxial/fit.png",
    "tutorial-gel.png": "gel.png",
    "tutorial-sweep.png": "sweep/sweep.png",
}


def keep(text: str) -> bool:
    """Write a block into the file that its first line names; whether it names one."""
    name = NAMED.match(text)
    if name is not None:
        Path(name[1]).write_text(text, encoding="utf-8")
    return name is not None


def without_numbers(line: str) -> str:
    """What of a line of output is the same in every run."""
    return re.sub(r"\s+", " ", NUMBER.sub("#", line)).strip()


def printed_as(shown: str, printed: str) -> Iterator[str]:
    """The lines of a block of output, with the numbers of what was printed; LookupError for one that was not."""
    lines = iter(printed.splitlines())
    for line in shown.splitlines():
        if line == "...":
            yield line
            continue
        found = next(
            (each for each in lines if without_numbers(each) == without_numbers(line)), None
        )
        if found is None:
            raise LookupError(f"{line!r} was not printed, but: {printed[-2000:]}")
        yield found.rstrip()


def obey(line: str) -> str:
    """Run one command of a page; what it prints."""
    words = shlex.split(line.removeprefix("./with-fenicsx "))
    if words[0] in ("git", "cd"):
        return ""
    started = time.monotonic()
    done = subprocess.run([sys.executable if words[0] == "python3" else words[0], *words[1:]], stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True)  # fmt: skip
    print(f"{time.monotonic() - started:6.1f} s  {line}", flush=True)
    if done.returncode:
        sys.exit(f"{line}: exit status {done.returncode}\n{done.stdout[-2000:]}")
    return done.stdout


def brought_up_to_date(text: str) -> str:
    """A page with the outputs of its commands, which have been run in the present folder."""
    pieces, end, printed = [], 0, ""
    for block in BLOCK.finditer(text):
        language, content = block.groups()
        if language == "sh":
            printed = "".join(map(obey, content.splitlines()))
        elif language in ("toml", "python", "text"):
            keep(content)
        elif language == "output":
            content = "".join(f"{line}\n" for line in printed_as(content, printed))
        pieces += [text[end : block.start()], f"```{language}\n{content}```"]
        end = block.end()
    return "".join(pieces) + text[end:]


def make(keep: bool) -> None:
    """All pages in one folder: they use each other's files. There is nothing to keep."""
    order = re.findall(
        r"\((tutorial_\w+|fit|howto_ranks)\.md\)", (DOCS / "index.md").read_text(encoding="utf-8")
    )
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        Path("demos").symlink_to(DOCS.parent / "demos")
        for page in ("start", *order):
            path = DOCS / f"{page}.md"
            text = path.read_text(encoding="utf-8")
            path.write_text(brought_up_to_date(text), encoding="utf-8")
            for name in re.findall(r"figures/(tutorial-[\w-]+\.png)", text):
                save_small(Path(PICTURES[name]), DOCS / "figures" / name)
