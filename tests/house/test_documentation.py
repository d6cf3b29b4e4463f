"""Pages that are made from the code are those that the code makes, and what they show runs as it stands."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

import remodel_fenicsx
from remodel_fenicsx import cli
from tests.conftest import mpirun
from tests.forks import COARSE, forked
from tests.processes import ran

ROOT = Path(__file__).parents[2]


def page(name: str | Path) -> str:
    """Its text."""
    return (ROOT / name).read_text(encoding="utf-8")


def test_pages_that_need_no_run_are_those_that_the_code_makes() -> None:
    """Keys, schema, public interface, columns; what is added, renamed or dropped shows in their own history."""
    made = ran([sys.executable, ROOT / "docs/make", "--check"])
    assert (
        made.returncode == 0
    ), f"if that is meant (CHANGELOG.md says so, where it is public):\n{made.stdout}{made.stderr}"


def test_the_python_of_the_readme_runs_as_it_stands(tmp_path: Path) -> None:
    """With both commands that stand after it, in their order."""
    (code, commands) = re.findall(
        r"```python\n(.*?)```\n\nSave it as `artery.py` and run (.*?)\. ",
        page("README.md"),
        re.DOTALL,
    )[0]
    one, two = (command.split() for command in re.findall(r"`./with-fenicsx (.*?)`", commands))
    short, number = re.subn(r'"time\.end": 30\.0', '"time.end": 1.0', code)
    assert number == 1 and one[0] == "python3" and two == ["mpirun", "-n", "2", *one]
    (tmp_path / "artery.py").write_text(COARSE + short)
    outputs = [forked("python", COARSE + short, cwd=tmp_path)]
    command = mpirun(2, sys.executable, "artery.py")
    outputs.append(ran(command, cwd=tmp_path))
    for done, folder in zip(outputs, ("tube", "tube-2"), strict=True):
        assert done.returncode == 0, done.stderr[-2000:]
        *steps, radii = done.stdout.strip().split("\n")
        assert [float(line.split()[0]) for line in steps] == [1.0]
        recorded = [float(radius) for radius in radii.strip("[]").split()]
        assert recorded == pytest.approx(
            [3.0, *(float(line.split()[1]) for line in steps)], abs=1e-7
        )
        assert (tmp_path / "results" / folder / "fields.vtkhdf").exists()


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", *(f"docs/{name}.md" for name in (
    "architecture", "commands", "start", "interface", "model", "solver", "time_integration", "verification",
    "reliability"))])  # fmt: skip
def test_files_and_modules_that_a_page_names_are_there(name: str) -> None:
    """Paths in backticks, and modules after the package's name."""
    text = re.sub(r"```.*?```", "", page(name), flags=re.DOTALL)
    rooms = "model|fem|kernels|body|scene|state|solver|evolution|watch|results|report|system|schema"
    paths = re.findall(rf"`((?:{rooms}|tests|docs|demos|benchmarks|meshes)/[\w/-]+\.\w+)`", text)
    for path in paths:
        places = (ROOT / path, ROOT / "remodel_fenicsx" / path)
        assert any(place.exists() for place in places), path
    for module in re.findall(r"remodel_fenicsx(?:\.\w+)+", text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").exists(), module


def named_sections(text: str) -> list[tuple[str, str]]:
    """Page and section of `docs/page.md, Section` in prose, comments, docstrings and strings in several parts."""
    text = re.sub(r"[\"']\s*\n\s*f?[\"']", "", text)
    text = re.sub(r"\s*\n\s*(?:# )?", " ", text)
    return re.findall(r"(?:docs/|\]\()(\w+)\.md\)?, \"?([A-Z][\w -]+\w)", text)


def test_sections_that_are_named_are_there() -> None:
    """By run messages, docstrings and pages."""
    files = [
        *ROOT.glob("remodel_fenicsx/**/*.py"),
        *ROOT.glob("benchmarks/**/*.py"),
        *ROOT.glob("docs/*.md"),
    ]
    heads = {file.stem: re.findall(r"^#+ (.*)$", page(file), re.M) for file in files}
    found = {
        (file.name, name, section) for file in files for name, section in named_sections(page(file))
    }
    assert len(found) > 30
    assert not [
        one for one in found if not any(one[2].startswith(head) for head in heads.get(one[1], []))
    ]
    assert named_sections('"so (docs/model.md, No "\n    "section)"') == [("model", "No section")]


def test_commands_that_pages_show_are_commands(capsys: pytest.CaptureFixture[str]) -> None:
    """With options that they have; whether they do what the page says, tests of the page ask."""
    found = 0
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if path.name == "interface.md":  # a synopsis
            continue
        for block in re.findall(r"^```(?:sh|text)\n(.*?)^```", page(path), re.M | re.S):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.match(
                    r"(?:\./with-fenicsx )?(?:mpirun -n \S+ )?remodel-fenicsx (.*)", line
                )
                if command is None or line.startswith("remodel-fenicsx: "):  # a message
                    continue
                words = shlex.split(re.sub(r" > .*|  +#.*", "", command[1]))
                try:
                    cli.parser().parse_args(words)
                except SystemExit as end:
                    assert not end.code, f"{path.name}: {line}: {capsys.readouterr().err}"
                found += 1
    assert found > 50


def test_the_project_keeps_within_its_ceilings() -> None:
    """Tokens of the package and of benchmarks, modules and pages (tests/house/size)."""
    size = runpy.run_path(f"{ROOT}/tests/house/size")
    sizes, _ = size["measured"]()
    assert all(sizes[name] <= most for name, most in size["CEILINGS"].items()), sizes


def test_tables_and_pictures_of_pages_are_of_this_version() -> None:
    """By the stamps that their studies write (`docs/make NAME` makes them anew)."""
    stamps = {
        path.name: json.loads(path.read_text())["made by"]
        for path in (ROOT / "docs/figures").glob("*.json")
    }
    assert len(stamps) > 20
    assert not {
        name: stamp
        for name, stamp in stamps.items()
        if stamp.split()[-1] != remodel_fenicsx.__version__
    }


def test_pages_are_short() -> None:
    """At most 2,600 words without generated blocks; all of scene.md is generated."""
    generated = r"(?s)<!-- ([\w ]+): .*?<!-- end of \1 -->"
    assert not [
        path
        for path in {*ROOT.glob("docs/*.md")} - {ROOT / "docs/scene.md"}
        if len(re.sub(generated, "", page(path)).split()) > 2600
    ]


def test_no_file_has_marks_of_a_merge_conflict() -> None:
    assert ran(["git", "grep", "-IlE", "^(<{7}|>{7}) "], cwd=ROOT).returncode == 1


LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)[^)]*\)")


def test_every_link_between_files_leads_to_one() -> None:
    """In the repository, as a reader of it follows them; those of the site: tests/house/test_site.py."""
    links = [
        (path, link)
        for pattern in ("*.md", "docs/*.md", "demos/**/*.md", "paper/*.md")
        for path in ROOT.glob(pattern)
        for link in LINK.findall(page(path))
    ]
    assert len(links) > 100
    assert not [
        f"{path.relative_to(ROOT)}: {link}"
        for path, link in links
        if not (path.parent / link).exists()
    ]


def test_a_name_that_the_package_does_not_have_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        remodel_fenicsx.nothing  # noqa: B018


# ---------------------------------------------------------------- scripts beside the package


STUDIES = """
from docs.making import studies
row = studies.stiff_tendon("tendon", **{"time.end": 1.0, "material.energy_factor": 1})
assert 1.1 < row["mean_stretch"] < 1.3 and row["time"] == 1.0, row
"""


def test_the_studies_of_the_verification_page_run(tmp_path: Path) -> None:
    """Short ones; the comparisons with the radial reference are tests of their own."""
    done = forked(
        "python", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{STUDIES}", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-2000:]
