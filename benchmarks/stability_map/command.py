"""The command `benchmarks/stability.py`: which cases are to run, on which cores, and what becomes of the results."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from benchmarks.stability_map import report
from benchmarks.stability_map.cases import FAMILIES, Case, all_cases
from benchmarks.stability_map import running


def main(description: str | None, arguments: list[str] | None = None) -> int:
    """Run what is missing, print the table; 1 if a case is wrong."""
    parser = running.parser_of(description, 120, "stability")
    parser.add_argument(
        "--family", action="append", default=[], metavar="NAME", help="only cases of this family"
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="TEXT",
        help="only cases whose key contains it",
    )
    parser.add_argument("--reduced", action="store_true", help="only the cases of the test")
    parser.add_argument(
        "--report",
        action="store_true",
        help="write table and picture of docs/reliability.md, run nothing",
    )
    options = parser.parse_args(arguments)
    if options.report:
        return report.write(options.results, all_cases(), running.source_of())
    cases = chosen(options, parser)
    source = running.source_of()
    file = running.file_of(options, source)
    done = {} if options.again else measured(file, source, cases, options.limit)
    missing = [key for key in cases if key not in done]
    print(
        f"{source}: {len(cases)} cases, {len(missing)} to run with {options.jobs} processes; {file}",
        file=sys.stderr,
    )
    jobs = {key: partial(running.evaluated, cases[key], source=source) for key in missing}
    done |= running.measure(jobs, said, source, options)
    records = [done[key] for key in cases if key in done]
    print(report.table(report.counts(records)))
    for record in records:
        if record["outcome"] in ("wrong", "unchecked") or options.only:
            print(
                f"{record['outcome']}: {record['key']}: {record['words']}\n    {cases[record['key']].command}"
            )
    return int(any(record["outcome"] == "wrong" for record in records))


def said(record: running.Record) -> str:
    """A line on a case."""
    return f"{record['outcome']:9} {record['total']:6.1f} s  {record['key']}"


def chosen(options: argparse.Namespace, parser: argparse.ArgumentParser) -> dict[str, Case]:
    """The cases that were asked for."""
    cases = {
        key: case
        for key, case in all_cases().items()
        if (not options.family or case.family in options.family)
        and (not options.only or any(text in key for text in options.only))
        and (not options.reduced or case.reduced)
    }
    if not cases:
        parser.error(f"no such case; families are {', '.join(FAMILIES)}; see --list")
    return cases


def measured(
    file: Path, source: str, cases: dict[str, Case], limit: float = 0.0
) -> dict[str, running.Record]:
    """What has been measured of these cases with this package, by key; the last one of each."""
    found = {}
    for record in running.read_records(file):
        case = cases.get(record["key"])
        if (
            case is not None
            and record["source"] == source
            and record["digest"] == running.digest(case)
        ):
            found[record["key"]] = record
    # what had no end may have one within more time
    return {
        key: record for key, record in found.items() if record.get("no_end_within", limit) >= limit
    }
