"""Where a run is, from its folder alone: what `remodel-fenicsx status DIR` says. It needs no dolfinx."""

from __future__ import annotations

import os
import time as clock
from datetime import datetime
from pathlib import Path

import numpy as np

from remodel_fenicsx.results.checkpoint_file import read_pointer
from remodel_fenicsx.results.recording import HISTORY, HistoryColumns, Recording, RecordingError, read_history
from remodel_fenicsx.results.run_lock import lock_holder
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.system.terminal import duration

RECENT = 20  # steps whose mean is the rate


def status(folder: Path) -> list[str]:
    """Lines for people: where the run is, whether it is alive, its rate, its checkpoint.

    Raises
    ------
    RecordingError, SceneError, CheckpointError
        If it is no folder of a run, or damaged.
    OSError
        If it cannot be read.
    """
    holder, lives = lock_holder(folder)
    if not lives or (folder / HISTORY).exists():
        recording = Recording(folder)  # what is no run's folder is refused
    else:
        return [f"{folder}: starting, {holder or 'a process'} is at work"]
    scene, history = recording.scene, _rows(recording, lives)
    times = history["time"]
    end, time = scene.last_time, float(times[-1]) if len(times) else 0.0
    number = max(0, len(times) - 1)
    steps, behind = scene.time.number_of_steps, scene.time.progress(number, time)
    of = f" of {steps}" if scene.time.tolerance is None else ""
    done = same_time(time, end)
    lines = [f"{folder}: {scene.name}, step {number}{of}, time {time:g} of {end:g}"]
    seconds = history.get("seconds", np.zeros(0))[1:][-RECENT:]
    rate = float(np.mean(seconds)) if len(seconds) else 0.0
    if lives:
        age = clock.time() - os.stat(folder / HISTORY).st_mtime
        per_step = number / behind if behind else 1.0  # those of a tolerance are longer or shorter than the first
        left = f", {duration(rate * per_step * (steps - behind))} left" if rate else ""
        lines.append(f"running: {holder or 'a process'}{left}; the last step was done {duration(max(0.0, age))} ago")
    elif done:
        lines.append("finished")
    else:
        when = f"{datetime.fromtimestamp(os.stat(folder / HISTORY).st_mtime):%Y-%m-%d %H:%M:%S}"
        killed = f"; {holder} was killed" if holder else ""
        lines.append(f"not running, the last step was done at {when}{killed}")
    if rate:
        lines.append(f"{rate:.3g} s a step (mean of the last {len(seconds)})")
    generations = read_pointer(folder)
    kept = f"checkpoint at time {generations[0].time:g}" if generations else "no checkpoint yet"
    lines.append(kept if lives or done else f"{kept}; it goes on with: remodel-fenicsx run --resume {folder}")
    return lines


def _rows(recording: Recording, lives: bool) -> HistoryColumns:
    """The history; of a run that lives it may be read while a row is being written."""
    try:
        return recording.history
    except RecordingError:
        if not lives:
            raise
        clock.sleep(0.1)
        return read_history(recording.path)
