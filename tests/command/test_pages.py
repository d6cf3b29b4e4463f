"""Each command and each file of start, tutorials, how-to pages and custom components, with short times.

What a page says that a command prints is compared, all but the numbers. `docs/make tutorials` runs the same pages in
full and brings numbers and pictures up to date. pages.toml lists the commands that are shown and not run, and why.
tests/studies/test_fit.py asks for the numbers of docs/fit.md; docs/my_own_vessel.md is run by
tests/body/test_my_own_vessel.py.
"""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs.making.tutorials import BLOCK, keep, printed_as
from remodel_fenicsx import cli, read_scene
from tests.conftest import forked_children
from tests.forks import forked
from tests.processes import ran

ROOT = Path(__file__).parents[2]
TUBE = "tutorial_tube"
OF_PAGES = tomllib.loads((Path(__file__).parent / "pages.toml").read_text(encoding="utf-8"))
SHORT, LIGHT, NOT_RUN, LEFT_BEHIND = (
    OF_PAGES[name] for name in ("short", "light", "not_run", "left_behind")
)
REFUSAL = "loads.force"
SCRIPT = "import runpy, sys; sys.path.insert(0, '.'); del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
PAGES = [
    "start",
    "fit",
    "architecture",
    *sorted(
        page.stem for kind in ("tutorial", "howto") for page in (ROOT / "docs").glob(f"{kind}_*.md")
    ),
]


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each block, with short times."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    for long, short in SHORT.items():
        text = text.replace(long, short)
    return BLOCK.findall(text)


def is_left_out(line: str) -> bool:
    """Whether it is a command that no test runs, for a reason that is said."""
    return line.startswith(tuple(NOT_RUN))


def of_the_demos(name: str) -> Path:
    """A file of the demos, or a copy that makes less work: a mesh of few elements, a fit that begins near its end."""
    text = few = (ROOT / name).read_text(encoding="utf-8")
    for heavy, light in LIGHT.items():
        few = few.replace(heavy, light)
    is_same = few == text
    copy = Path(f"few-{Path(name).name}")
    for data in (ROOT / name).parent.glob("*.csv"):
        few = few.replace(f'"{data.name}"', f'"{data}"')
    copy.write_text(few, encoding="utf-8")
    return ROOT / name if is_same else copy


def obey(line: str, capture: pytest.CaptureFixture[str]) -> str:
    """One command of a page; what it prints."""
    program, *words = shlex.split(line.removeprefix("./with-fenicsx "))
    words = [str(of_the_demos(word)) if word.startswith("demos/") else word for word in words]
    if program == "remodel-fenicsx" and "--with" in words:  # this process does without its parts
        done = forked("remodel-fenicsx", *words)
        assert done.returncode == 0, line + done.stderr
        return done.stderr + done.stdout
    if program == "remodel-fenicsx":
        assert cli.main(words) == 0, line
        results, progress = capture.readouterr()
        return progress + results
    if program == "cp":
        shutil.copy(*words)
        return ""
    if program == "python3":
        done = forked("python", SCRIPT, *words)
    else:
        assert program == "mpirun", line
        done = ran([program, *words])
    assert done.returncode == 0, line + "\n" + done.stderr[-1000:]
    return done.stdout + done.stderr


@pytest.fixture
def all_forked(drawn_by_forks: None) -> Iterator[None]:
    """What the commands start is forked: pictures, and the runs of studies."""
    with forked_children():
        yield


@pytest.mark.usefixtures("all_forked")
@pytest.mark.parametrize("page", PAGES)
def test_a_reader_gets_through_the_page(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    if page != "howto_ranks":  # whose ranks are processes of their own
        monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 4, 1))
    if page != TUBE:
        for _, text in blocks(TUBE):
            keep(text)
    printed = ""
    for language, text in blocks(page):
        if language == "sh":
            printed = "".join(
                obey(line, capsys) for line in text.splitlines() if not is_left_out(line)
            )
        elif language == "output":
            assert list(printed_as(text, printed))
        elif not keep(text):
            assert language == "text", f"a block that no file takes: {text[:60]}"
    for name in LEFT_BEHIND[page]:
        assert Path(name).stat().st_size > 0, name


@pytest.mark.parametrize("page", PAGES)
def test_no_command_of_a_page_is_passed_over_in_silence(page: str) -> None:
    """In blocks of text, and in those whose language the test does not know."""
    for language, text in blocks(page):
        assert language in ("sh", "output", "python", "toml", "text"), language
        if language == "text":
            commands = [
                line
                for line in text.splitlines()
                if re.match(r"(\./|docker |podman |apptainer |sbatch |git |cd |python3? )", line)
            ]
            assert all(map(is_left_out, commands)), commands


def test_what_is_said_to_be_shortened_or_left_out_is_there() -> None:
    text = "".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8") for page in PAGES)
    assert all(words in text for words in (*SHORT, *NOT_RUN))


def test_the_refusal_of_the_first_page_is_the_one_that_is_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (text,) = (text for language, text in blocks("start") if language == "text" and REFUSAL in text)
    command, *shown = text.splitlines()
    words = [
        str(ROOT / word) if word.startswith("demos/") else word for word in shlex.split(command)[2:]
    ]
    assert cli.main(words) == 2
    assert capsys.readouterr().err.split() == " ".join(shown).split()


@pytest.mark.usefixtures("all_forked")
def test_the_examples_of_the_readme_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the scene that it shows; tests/house/test_documentation.py runs its Python."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for long, short in OF_PAGES["short_readme"].items():
        assert long in text
        text = text.replace(long, short)
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 4, 1))
    assert [keep(block) for kind, block in BLOCK.findall(text) if kind == "toml"] == [True]
    lines = [line.partition("    #")[0] for kind, block in BLOCK.findall(text) if kind == "sh"
             for line in block.splitlines() if not is_left_out(line)]  # fmt: skip
    tests = lines.pop(1)
    assert tests.split() == ["./with-fenicsx", "tests/run"] and len(lines) == 4
    for line in lines:
        obey(line, capsys)
    assert Path("results/artery/report.html").exists() and Path("high/report.html").exists()


def test_the_tube_of_the_readme_is_that_of_its_tutorial_and_so_are_its_numbers() -> None:
    """`docs/make tutorials` makes the numbers."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    ((_, scene),) = (block for block in BLOCK.findall(readme) if block[0] == "toml")
    (tutorial,) = (
        text
        for kind, text in BLOCK.findall((ROOT / f"docs/{TUBE}.md").read_text())
        if kind == "toml"
    )
    assert tomllib.loads(scene) | {"name": "tube"} == tomllib.loads(tutorial)
    numbers = re.findall(
        r"([\d.]+) mm, (?:\w+ )*?(?:from 45 to )?([\d.]+) degrees", readme.replace("\n", " ")
    )
    printed = dict(
        re.findall(r"-> ([\d.]+) mm, ([\d.]+) degrees", (ROOT / f"docs/{TUBE}.md").read_text())
    )
    assert dict(numbers) == printed and len(printed) == 2


def test_numbers_of_an_experiment_go_into_the_tutorials_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/concepts.md: its table in place of the one of `tube.toml`."""
    monkeypatch.chdir(tmp_path)
    for _, text in blocks(TUBE):
        keep(text)
    page = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^```toml\n(\[material\]\n.*?)^```", page, re.MULTILINE | re.DOTALL)
    scene = re.sub(
        r"^\[material\]\n.*?(?=^\[)",
        "",
        Path("tube.toml").read_text(),
        flags=re.MULTILINE | re.DOTALL,
    )
    scene = (
        re.sub(r"^kappa = .*\n", "", scene, flags=re.MULTILINE) if "half_life" in table else scene
    )
    merged, _, remodeling = table.partition("[remodeling]")
    scene = scene.replace("[remodeling]", f"{merged}\n[remodeling]{remodeling}")
    Path("mine.toml").write_text(scene)
    assert read_scene("mine.toml").material.contour_length == 1.35
