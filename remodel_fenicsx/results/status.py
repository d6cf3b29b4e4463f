"""The state of a run from its folder, for `remodel-fenicsx status DIR`, without dolfinx."""

from __future__ import annotations

import math
import os
import re
import time as clock
from collections import Counter
from datetime import datetime
from pathlib import Path

import numpy as np

from remodel_fenicsx.results.checkpoint_file import time_of_checkpoint
from remodel_fenicsx.results.recording import (
    HISTORY,
    LARGEST_HISTORY,
    LOG,
    SCENE,
    RecordedRun,
    RecordingError,
    lock_holder,
)
from remodel_fenicsx.system.files import read_regular, command_name
from remodel_fenicsx.system.terminal import duration

RECENT = 20  # steps whose mean is the rate
# beginnings of the lines of run.log on a run's start and end
BEGUN = "scene "
FAILED, STOPPED = "failed: ", "ended: "
OVERRIDE = "set by --set: "
_LOG_ENTRY = re.compile(
    r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\S* ([A-Z]+) (.*?)\n?(?=^\d{4}-\d\d-|\Z)", re.M | re.S
)


def status(folder: Path) -> list[str]:
    """Return lines for people on a run, or on the runs of a study.

    A run's lines have its step, whether its process lives, its rate and its checkpoint.
    """
    if runs := (
        []
        if (folder / SCENE).exists()
        else sorted(path.parent for path in folder.glob(f"*/{SCENE}"))
    ):
        return _of_study(folder, runs)
    holder, lives = lock_holder(folder)
    if not lives or (folder / HISTORY).exists():
        recording = RecordedRun(folder)  # rejects a folder without a run
    else:
        return [f"{folder}: starting, {holder or 'a process'} is at work"]
    scene, history = recording.scene, recording.history
    times = history["time"]
    end, time = scene.last_time, float(times[-1]) if len(times) else 0.0
    number = max(0, len(times) - 1)
    steps, behind = scene.time.number_of_steps, scene.time.progress(number, time)
    of = f" of {steps}" if scene.time.tolerance is None else ""
    state, reason = state_of(recording)
    lines = [f"{folder}: {scene.name}, step {number}{of}, time {time:g} of {end:g}"]
    seconds = history.get("seconds", np.zeros(0))[1:][-RECENT:]
    rate = float(np.mean(seconds)) if len(seconds) else 0.0
    if lives:
        age = clock.time() - os.stat(folder / HISTORY).st_mtime
        # adaptive steps are longer or shorter than the first
        per_step = number / behind if behind else 1.0
        left = f", {duration(rate * per_step * (steps - behind))} left" if rate else ""
        lines.append(
            f"running: {holder or 'a process'}{left}; "
            f"the last step was done {duration(max(0.0, age))} ago"
        )
    elif state == "finished":
        lines.append(state)
    else:
        if state == "failed":
            lines.append(f"{FAILED}{reason}")
        when = f"{datetime.fromtimestamp(os.stat(folder / HISTORY).st_mtime):%Y-%m-%d %H:%M:%S}"
        killed = f"; {holder} was killed" if holder else ""
        lines.append(f"not running, the last step was done at {when}{killed}")
        if state == "stopped" and reason:  # a signal, or the whole sentence of a stop on purpose
            lines[-1] += f"; {reason if reason.startswith('stopped') else f'stopped by {reason}'}"
    if rate:
        lines.append(f"{rate:.3g} s a step (mean of the last {len(seconds)})")
    time_kept = time_of_checkpoint(folder)
    kept = "no checkpoint yet" if time_kept is None else f"checkpoint at time {time_kept:g}"
    lines.append(
        kept
        if lives or state == "finished"
        else f"{kept}; resume it with: {command_name()} run --resume {folder}"
    )
    return lines


def log_entries(folder: Path) -> list[tuple[str, str, str]]:
    """Return stamp, level and text of each entry of run.log; a text may have several lines."""
    text = (
        read_regular(folder / LOG, LARGEST_HISTORY).decode(errors="replace")
        if (folder / LOG).exists()
        else ""
    )
    return _LOG_ENTRY.findall(text)


def state_of(recording: RecordedRun) -> tuple[str, str]:
    """Return "finished", "failed", "stopped" or "running", and the reason in run.log."""
    times = recording.history["time"]
    if len(times) and math.isclose(float(times[-1]), recording.scene.last_time):
        return "finished", ""
    state, reason = _outcome_from_log(recording.path)
    return ("running" if not reason and lock_holder(recording.path)[1] else state), reason


def _outcome_from_log(folder: Path) -> tuple[str, str]:
    """Return "failed" or "stopped" and the reason from run.log; no reason if the run was killed."""
    said = [text.partition("\n")[0] for _, _, text in log_entries(folder)]
    last = next(
        (text for text in reversed(said) if text.startswith((BEGUN, FAILED, STOPPED))), BEGUN
    )
    if last.startswith(FAILED):
        return "failed", last.removeprefix(FAILED)
    return "stopped", last.removeprefix(STOPPED) if last.startswith(STOPPED) else ""


def _of_study(folder: Path, runs: list[Path]) -> list[str]:
    """Return lines that count a study's runs by state and give the reasons of failed runs."""
    states = {run.name: _state(run) for run in runs}
    counted = Counter(state for state, _ in states.values())
    lines = [
        f"{folder}: {len(runs)} runs: {', '.join(f'{n} {state}' for state, n in counted.items())}"
    ]
    return lines + [
        f"{run} has {FAILED}{words}" for run, (state, words) in states.items() if state == "failed"
    ]


def _state(folder: Path) -> tuple[str, str]:
    """Return the state of a study's run, and the reason if it has failed."""
    if lock_holder(folder)[1]:
        return "running", ""
    try:
        return state_of(RecordedRun(folder))
    except RecordingError:
        return _outcome_from_log(folder)
