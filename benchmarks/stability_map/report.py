"""Tables, the page docs/stability.md, its appendix and its picture, from what has been measured."""

from __future__ import annotations

import datetime
import json
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

from benchmarks.stability_map.cases import Case
from benchmarks.stability_map.judging import OUTCOMES

Record = dict[str, Any]
PROJECT = Path(__file__).resolve().parents[2]
PAGES = ("stability", "appendix_stability")  # docs/NAME.md from docs/NAME.template.md
BEFORE = Path(__file__).with_name("results-0.1.0.jsonl")


def read_records(file: Path) -> list[Record]:
    """All lines of a file of results; one that was cut off at the end is left out."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def latest(records: Iterable[Record], cases: Mapping[str, Case], digest: Any = None, source: str = "") -> list[Record]:
    """The last record of each case, in the order of the cases; with a digest only of the case as it is now."""
    found = {}
    for record in records:
        case = cases.get(record["key"])
        now = case is not None and (digest is None or record["digest"] == digest(case))
        if now and source in ("", record["source"]):
            found[record["key"]] = record
    return [found[key] for key in cases if key in found]


# ---------------------------------------------------------------- tables
EXTRA = ("false alarms", "refused, no cause")


def counts(records: Iterable[Record]) -> dict[str, Counter[str]]:
    """Outcomes by family, and of all under `all`."""
    rows: dict[str, Counter[str]] = {}
    for record in records:
        row = rows.setdefault(record["family"], Counter())
        row[record["outcome"]] += 1
        row["false alarms"] += bool(record["false_alarm"])
        row["refused, no cause"] += record["cause_named"] is False
    rows["**all**"] = sum(rows.values(), Counter())
    return rows


def used(total: Counter[str]) -> list[str]:
    """Columns that are not empty; `wrong` in any case, which should be."""
    return [name for name in (*OUTCOMES, *EXTRA) if total[name] or name == "wrong"]


def table(records: Iterable[Record]) -> str:
    """Outcomes by family, as Markdown."""
    rows = counts(records)
    columns = used(rows["**all**"])
    lines = ["| family | cases | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for name, row in rows.items():
        number = sum(row[outcome] for outcome in OUTCOMES)
        lines.append(f"| {name} | {number} | " + " | ".join(str(row[c] or "") for c in columns) + " |")
    return "\n".join(lines)


def comparison(before: Sequence[Record], after: Sequence[Record]) -> str:
    """Totals of both, over all cases and over those that both can express, as Markdown."""
    both = {record["key"] for record in after}
    there = {record["key"] for record in before if record["outcome"] != "not there"}
    columns = used(sum((counts(records)["**all**"] for records in (before, after)), Counter()))
    lines = ["| | cases | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for name, records in (
        ("0.1.0", before),
        ("now", after),
        ("0.1.0, run with both", [record for record in before if record["key"] in both & there]),
        ("now, run with both", [record for record in after if record["key"] in both & there]),
    ):
        row = counts(records)["**all**"]
        number = sum(row[outcome] for outcome in OUTCOMES)
        lines.append(f"| {name} | {number} | " + " | ".join(str(row[c] or "") for c in columns) + " |")
    return "\n".join(lines)


def listed(records: Iterable[Record], cases: Mapping[str, Case], chosen: Any) -> str:
    """The chosen cases as Markdown, with what is said of them; for the first of a family the command that shows it."""
    lines, commands = ["| case | what is said |", "|---|---|"], dict[str, str]()
    for record in records:
        if chosen(record):
            words = shorten(record["words"].replace("|", "/"), 200, placeholder=" ...")
            lines.append(f"| {record['key']} | {words} |")
            commands.setdefault(record["family"], cases[record["key"]].command)
    shown = "\n".join(("One of each family again:\n\n```sh", *commands.values(), "```"))
    return "\n".join(lines) + f"\n\n{shown}" if commands else "None."


# ---------------------------------------------------------------- the picture
COLOURS = {
    "right": "#3a923a", "refused": "#9ecae1", "unstable": "#3182bd", "warned": "#f0c808", "wrong": "#c1272d",
    "unchecked": "#8c6bb1", "not there": "#e6e6e6", "not run": "#ffffff",
}  # fmt: skip
WIDTH = 40  # squares in a row


def mosaic(axes: Any, cases: Mapping[str, Case], records: Iterable[Record], title: str) -> None:
    """A square for each case, rows for each family, coloured by its outcome; a dot is a false alarm."""
    from matplotlib.patches import Rectangle

    found = {record["key"]: record for record in records}
    families: dict[str, list[str]] = {}
    for key, case in cases.items():
        families.setdefault(case.family, []).append(key)
    y, ticks = 0, []
    for name, keys in families.items():
        ticks.append((y + 0.5, name))
        for number, key in enumerate(keys):
            record = found.get(key)
            x, down = number % WIDTH, number // WIDTH
            colour = COLOURS[record["outcome"] if record else "not run"]
            axes.add_patch(Rectangle((x, y + down), 0.9, 0.9, facecolor=colour, edgecolor="#bbbbbb", linewidth=0.2))
            if record and record["false_alarm"]:
                axes.plot(x + 0.45, y + down + 0.45, ".", color="black", markersize=2)
        y += (len(keys) - 1) // WIDTH + 1.4
    axes.set(xlim=(-0.3, WIDTH), ylim=(y, -0.3), title=title, xticks=[])
    axes.set_yticks([at for at, _ in ticks], [name for _, name in ticks], fontsize=7)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def draw(file: Path, cases: Mapping[str, Case], sides: Mapping[str, Iterable[Record]]) -> None:
    """The heat map of several versions side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.patches import Patch

    figure, panels = pyplot.subplots(1, len(sides), figsize=(6.2 * len(sides), 8.5), sharey=True, layout="constrained")
    for axes, (title, records) in zip(panels, sides.items(), strict=True):
        mosaic(axes, cases, records, title)
    handles = [Patch(facecolor=colour, edgecolor="#bbbbbb", label=name) for name, colour in COLOURS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    figure.savefig(file, dpi=130)
    pyplot.close(figure)


# ---------------------------------------------------------------- the page
def write(results: Path, cases: Mapping[str, Case], source: str, digest: Any) -> int:
    """docs/stability.md, its appendix and its picture; 1 if nothing has been measured."""
    version = source.partition("+")[0]
    after = latest(read_records(results / f"{version}.jsonl"), cases, digest, source)
    before = latest([*read_records(BEFORE), *read_records(results / "0.1.0.jsonl")], cases)
    if not after:
        print(f"nothing has been measured with {source}: run benchmarks/stability.py first")
        return 1
    draw(PROJECT / "docs" / "figures" / "stability.png", cases, {"0.1.0": before, f"{version}, now": after})
    words = {
        "counts": comparison(before, after),
        "families": table(after),
        "families_before": table(before),
        "wrong": listed(after, cases, lambda record: record["outcome"] == "wrong"),
        "warned": listed(after, cases, lambda record: record["outcome"] == "warned"),
        "unchecked": listed(after, cases, lambda record: record["outcome"] == "unchecked"),
        "false_alarms": listed(after, cases, lambda record: record["false_alarm"]),
        "references": references(cases),
        "made": made(source, after, cases),
    }
    for page in PAGES:
        text = (PROJECT / "docs" / f"{page}.template.md").read_text(encoding="utf-8")
        for name, value in words.items():
            text = text.replace("{{" + name + "}}", value)
        (PROJECT / "docs" / f"{page}.md").write_text(text, encoding="utf-8")
    return 0


def references(cases: Mapping[str, Case]) -> str:
    """What each family is held against, as Markdown."""
    rows: dict[str, str] = {}
    for case in cases.values():
        rows.setdefault(case.family, case.reference)
    return "| family | reference |\n|---|---|\n" + "\n".join(f"| {name} | {words} |" for name, words in rows.items())


def made(source: str, records: Sequence[Record], cases: Mapping[str, Case]) -> str:
    """With what, when, how much of it."""
    import scipy

    seconds = sum(record["total"] for record in records)
    missing = len(cases) - len(records)
    rest = f"; {missing} of {len(cases)} cases have not been run with it" if missing else ""
    return (
        f"Made with package {source}, numpy and scipy {scipy.__version__}, Python {platform.python_version()},\n"
        f"{datetime.date.today()}: {len(records)} cases, {seconds / 60:.0f} minutes of one core{rest}."
    )
