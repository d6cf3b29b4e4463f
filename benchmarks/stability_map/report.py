"""The table and the picture of docs/reliability.md, and what is said of cases, from what has been measured."""

from __future__ import annotations

import datetime
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import shorten

from benchmarks.stability_map.cases import Case
from benchmarks.stability_map.judging import OUTCOMES
from benchmarks.stability_map.running import Record, digest, read_records
from docs.making.pages import DOCS, FIGURES, between_marks, markdown

PAGE = DOCS / "reliability.md"
EXTRA = ("false alarms", "refused, no cause")
ALL = "**all**"
MEANINGS = {
    "right": "every row is within the tolerance of the reference",
    "refused": "exit code 2 or 3",
    "unstable": "an unstable equilibrium, of which the run warns",
    "warned": "an error above the tolerance, with a warning",
    "wrong": "the same as unstable or warned, without a warning",
    "unchecked": "no reference, or more than 120 s of CPU time",
    "false alarms": "right cases with a warning",
}


# ---------------------------------------------------------------- tables
def counts(records: Iterable[Record]) -> dict[str, Counter[str]]:
    """Outcomes by family, and of all under `all`."""
    rows: dict[str, Counter[str]] = {}
    for record in records:
        row = rows.setdefault(record["family"], Counter())
        row[record["outcome"]] += 1
        row["false alarms"] += bool(record["false_alarm"])
        row["refused, no cause"] += record["cause_named"] is False
    rows[ALL] = sum(rows.values(), Counter())
    return rows


def table(rows: Mapping[str, Counter[str]]) -> str:
    """Outcomes of each row; columns that are not empty, and `wrong` in any case."""
    columns = [name for name in (*OUTCOMES, *EXTRA) if rows[ALL][name] or name == "wrong"]
    cells = (
        [
            name,
            str(sum(row[outcome] for outcome in OUTCOMES)),
            *(str(row[column] or "") for column in columns),
        ]
        for name, row in rows.items()
    )
    return markdown(["family", "cases", *columns], cells)


def listed(
    records: Iterable[Record], cases: Mapping[str, Case], chosen: Callable[[Record], bool]
) -> str:
    """The chosen cases with what is said of them; for the first of a family the command that shows it."""
    rows, commands = list[list[str]](), dict[str, str]()
    for record in filter(chosen, records):
        rows.append(
            [record["key"], shorten(record["words"].replace("|", "/"), 200, placeholder=" ...")]
        )
        commands.setdefault(record["family"], cases[record["key"]].command)
    shown = "\n".join(("One of each family again:\n\n```sh", *commands.values(), "```"))
    return markdown(["case", "what is said"], rows) + f"\n\n{shown}" if commands else "None."


# ---------------------------------------------------------------- the picture
COLOURS = {
    "right": "#cfe1f2", "refused": "#6f6f6f", "unstable": "#2b6cb0", "warned": "#f0a202", "wrong": "#000000",
    "unchecked": "#b3b3b3", "not run": "#ffffff",
}  # fmt: skip
WIDTH = 60  # squares in a row


def draw(file: Path, cases: Mapping[str, Case], records: Iterable[Record]) -> None:
    """A square for each case, rows for each family, coloured by its outcome; a dot is a false alarm."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Rectangle

    figure, found = Figure(figsize=(8.5, 8.5), layout="constrained"), {
        record["key"]: record for record in records
    }
    axes, families = figure.subplots(), dict[str, list[str]]()
    for key, case in cases.items():
        families.setdefault(case.family, []).append(key)
    y, ticks = 0.0, []
    for name, keys in families.items():
        ticks.append((y + 0.5, name))
        for number, key in enumerate(keys):
            record = found.get(key)
            x, down = number % WIDTH, y + number // WIDTH
            colour = COLOURS[record["outcome"] if record else "not run"]
            axes.add_patch(
                Rectangle((x, down), 0.9, 0.9, facecolor=colour, edgecolor="#bbbbbb", linewidth=0.2)
            )
            if record and record["false_alarm"]:
                axes.plot(x + 0.45, down + 0.45, ".", color="black", markersize=2)
        y += (len(keys) - 1) // WIDTH + 1.4
    axes.set(xlim=(-0.3, WIDTH), ylim=(y, -0.3), xticks=[])
    axes.set_yticks([at for at, _ in ticks], [name for _, name in ticks], fontsize=7)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    handles = [
        Patch(facecolor=colour, edgecolor="#bbbbbb", label=name) for name, colour in COLOURS.items()
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False
    )
    figure.savefig(file, dpi=130)


# ---------------------------------------------------------------- the page
def write(results: Path, cases: Mapping[str, Case], source: str) -> int:
    """Table, picture, and cases.md beside the results; 1 if nothing has been measured."""
    of_package = [
        r
        for r in read_records(results / f"{source.partition('+')[0]}.jsonl")
        if r["source"] == source
    ]
    last = {
        r["key"]: r
        for r in of_package
        if r["key"] in cases and r["digest"] == digest(cases[r["key"]])
    }
    records = [last[key] for key in cases if key in last]
    if not records:
        print(f"nothing has been measured with {source}: run benchmarks/stability.py first")
        return 1
    draw(FIGURES / "stability.png", cases, records)
    rows = counts(records)
    totals = ([name, str(rows[ALL][name]), meaning] for name, meaning in MEANINGS.items())
    outcomes = markdown(["outcome", "cases", "meaning"], totals)
    families = f"{outcomes}\n\n{made(source, records, cases)}"
    PAGE.write_text(
        between_marks(PAGE.read_text(encoding="utf-8"), "families", families), encoding="utf-8"
    )
    parts = [f"# families\n\n{table(rows)}"]
    for outcome in ("wrong", "warned", "unchecked"):
        said = listed(records, cases, lambda r, outcome=outcome: r["outcome"] == outcome)  # type: ignore[misc]
        parts.append(f"# {outcome}\n\n{said}")
    parts += ["# false alarms\n\n" + listed(records, cases, lambda record: record["false_alarm"])]
    text = "\n\n".join([*parts, "# references\n\n" + references(cases)])
    (results / "cases.md").write_text(text + "\n", encoding="utf-8")
    return 0


def references(cases: Mapping[str, Case]) -> str:
    """What each family is held against."""
    rows: dict[str, str] = {}
    for case in cases.values():
        rows.setdefault(case.family, case.reference)
    return markdown(["family", "reference"], list(rows.items()))


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
