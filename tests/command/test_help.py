"""Help on the command line: it can be asked for, each option says something, and its examples are understood."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path

import pytest

from remodel_fenicsx import cli
from remodel_fenicsx.scene.presets import PRESETS, PROFILES

(SUBPARSERS,) = [
    action for action in cli.parser()._actions if isinstance(action, argparse._SubParsersAction)
]
OF_PROCESSES = {cli.SERVE, cli.PART}
COMMANDS: dict[str, argparse.ArgumentParser] = {
    name: found for name, found in SUBPARSERS.choices.items() if name not in OF_PROCESSES
}


def test_the_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0 and set(COMMANDS) == {*cli.COMMANDS} - OF_PROCESSES
    assert all(re.search(rf"^    {name} ", text, re.MULTILINE) for name in COMMANDS)
    assert all(re.search(rf"^  {code} +\w", text, re.MULTILINE) for code in cli.EXIT_CODES)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_examples_that_it_takes(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main([name, "--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0
    words = shlex.split(cli.COMMANDS[name].example.split(" > ")[0])
    assert f"  remodel-fenicsx {name}" in text and cli.parser().parse_args(words).command == name
    for action in COMMANDS[name]._actions:
        assert action.help and (
            action.dest == "help" or action.help[0].isupper() and action.help.endswith((".", ")."))
        )


def test_the_help_names_what_there_is_without_loading_it() -> None:
    assert set(PRESETS) <= set(re.findall(r"[\w-]+[\w]", COMMANDS["new"].format_help()))
    assert set(PROFILES) <= set(re.findall(r"\w+", COMMANDS["run"].format_help()))


@pytest.mark.parametrize("name", COMMANDS)
def test_the_page_of_commands_has_an_example(name: str) -> None:
    """In the section of the command; `docs/make options` lists its options."""
    page = (Path(__file__).parents[2] / "docs" / "commands.md").read_text(encoding="utf-8")
    (section,) = re.findall(rf"^### {name}\n(.*?)(?=^##)", page, re.MULTILINE | re.DOTALL)
    for line in re.findall(r"^\./with-fenicsx remodel-fenicsx (.*)$", section, re.MULTILINE):
        assert cli.parser().parse_args(shlex.split(line.split(" > ")[0])).command == name
    assert f"remodel-fenicsx {name}" in section
