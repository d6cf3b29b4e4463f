"""The command `benchmarks/fuzz.py`: which seeds are to run, and what becomes of the results."""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from random import Random

import numpy as np
import tomlkit

from benchmarks.fuzzing import references, relations
from benchmarks.fuzzing.relations import Other
from benchmarks.fuzzing.scenes import Values, cost, made
from benchmarks.stability_map.cases import Case, Finding, Run
from benchmarks.stability_map.judging import BAD_INPUT, NO_END, SOLVE_FAILED, Verdict, judged
from benchmarks.stability_map import running


def main(description: str | None, arguments: list[str] | None = None) -> int:
    """Run what is missing, print what has come of it; 1 if a scene is wrong."""
    parser = running.parser_of(description, 15, "fuzz")
    parser.add_argument("--seed", type=int, default=1, metavar="FIRST", help="the first seed (1)")
    parser.add_argument("--count", type=int, default=300, metavar="N", help="how many seeds (300)")
    parser.add_argument(
        "--only", type=int, metavar="SEED", help="this one, with its scene, whatever is there of it"
    )
    options = parser.parse_args(arguments)
    if options.only is not None:
        return _one(options.only, options.limit)
    by, seeds = running.judges("fuzzing", "stability_map")[:10], range(
        options.seed, options.seed + options.count
    )
    source = f"{running.source_of()} by {by}"
    file = running.file_of(options, source)
    there = (
        {}
        if options.again
        else {r["seed"]: r for r in running.read_records(file) if r["source"] == source}
    )
    done = {seed: there[seed] for seed in seeds if seed in there}
    # the cheap ones first: what is stopped has seen as many as it could
    missing = sorted(
        (seed for seed in seeds if seed not in done), key=lambda seed: cost(made(seed)[0])
    )
    print(f"{source}: {len(seeds)} scenes, {len(missing)} to run; {file}", file=sys.stderr)
    done |= running.measure(
        {seed: partial(evaluated, seed, source=source) for seed in missing}, said, source, options
    )
    print(summary([done[seed] for seed in seeds if seed in done]))
    return int(any(record["outcome"] == "wrong" for record in done.values()))


def evaluated(seed: int, runner: running.Runner, source: str = "") -> running.Record:
    """The scene of a seed, run twice and judged."""
    scene, counts = made(seed)
    other = relations.chosen(scene, Random(seed))
    run = runner.run({"scene": scene, "counts": counts})
    asked = {"scene": other.scene, "counts": counts, **other.asked}
    again = Run(NO_END, run.said) if run.code in (NO_END, BAD_INPUT) else runner.run(asked)
    verdict = verdict_on(scene, other, run, again)
    return {
        "seed": seed, "source": source, **asdict(verdict), "other": other.name, "reference": references.known(scene),
        "body": f"{scene['geometry']['shape']} {scene['model']['kinematics']}", "warnings": len(run.warnings),
        "seconds": round(run.seconds + again.seconds, 2),
    }  # fmt: skip


def verdict_on(scene: Values, other: Other, run: Run, again: Run) -> Verdict:
    """What all references say together; what no row may do is wrong whatever was said beside it."""
    faults = [] if run.code == NO_END else references.broken(scene, run)
    if again.code != NO_END:
        faults += [
            f"{other.name}: {fault}"
            for fault in references.broken(other.in_numbers or other.scene, again)
        ]
    ends = {run.code, again.code}
    if other.tolerance == relations.EXACT and len(ends) == 2 and NO_END not in ends:
        faults.append(
            f"{other.name}: exit {again.code} for {run.code}: {(again.said or run.said)[-300:].strip()}"
        )
    if faults:
        return Verdict("wrong", "; ".join(faults))
    findings = []
    if references.known(scene) and run.code in (0, SOLVE_FAILED):
        findings.append(references.compared(scene, run))
    if ends == {0}:
        finding = relations.compared(other, run, again)
        if (
            finding.ratio > 1 and again.warnings and not run.warnings
        ):  # nobody knows which of them is off
            finding = replace(
                finding, ratio=np.nan, words=f"{finding.words}, which says: {again.warnings[0]}"
            )
        findings.append(finding)
    known = [finding for finding in findings if not np.isnan(finding.ratio)]
    words = (
        "; ".join(finding.words for finding in findings)
        or f"{other.name}: {again.said.strip()[-200:]}"
    )
    ratio = max((finding.ratio for finding in known), default=np.nan if run.code == 0 else 0.0)
    worst = Finding(ratio, words, None, all(finding.solvable for finding in findings))
    return judged(Case("fuzz", "", scene, lambda case, run: worst, ""), run)


def said(record: running.Record) -> str:
    """A line on a seed."""
    alarm = " (false alarm)" if record["false_alarm"] else ""
    return f"{record['outcome']:9}{alarm} {record['seed']}: {record['body']}, {record['seconds']:g} s: {record['words']}"


def summary(records: list[running.Record]) -> str:
    """How many ended how, and those that are not right."""
    counts = Counter(record["outcome"] for record in records)
    lines = [said(record) for record in records if record["outcome"] in ("wrong", "unchecked")]
    lines += [
        f"{len(records)} scenes: "
        + ", ".join(f"{number} {outcome}" for outcome, number in counts.most_common())
    ]
    named = sum(bool(record["cause_named"]) for record in records)
    alarms, own = (
        sum(bool(record[key]) for record in records) for key in ("false_alarm", "reference")
    )
    return "\n".join(
        [*lines, f"refused with a cause {named}; false alarms {alarms}; own reference for {own}"]
    )


def _one(seed: int, limit: float) -> int:
    scene, counts = made(seed)
    other = relations.chosen(scene, Random(seed))
    print(
        tomlkit.dumps(scene),
        f"# elements: {counts}\n# held against: {other.name} {other.asked}",
        sep="",
    )
    changed = [
        line for line in tomlkit.dumps(other.scene).splitlines() if line not in tomlkit.dumps(scene)
    ]
    print("\n".join(f"#     {line}" for line in changed))
    with closing(running.Runner(limit)) as runner:
        record = evaluated(seed, runner)
    print(said(record))
    return int(record["outcome"] == "wrong")
