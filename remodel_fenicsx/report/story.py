"""How a run went, from its folder: whether it has ended and why, what it warned of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from remodel_fenicsx.results.recording import LARGEST_HISTORY, LOG, HistoryColumns, RecordedRun
from remodel_fenicsx.results.run_lock import writer
from remodel_fenicsx.results.status import FAILED, STOPPED, how_it_ended
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.system.regular_files import read_regular

_LINE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\S* ([A-Z]+) (.*)")
_STEP = re.compile(r"time (\S+?), ")
SAID_UNLOADED = "unloaded: "  # as logs say it
_RANKS = re.compile(r"scene .* on (\d+) ranks?, results in ")


@dataclass
class Warned:
    """A warning of a run, with others that differ from it in numbers alone.

    Attributes
    ----------
    text
        The first one's.
    count
        How many.
    time
        Of the last step before the first; "" before any.
    """

    text: str
    count: int
    time: str


@dataclass(frozen=True)
class Story:
    """How a run went.

    Attributes
    ----------
    state
        "finished", "running", "failed" or "stopped".
    words
        Where it is or why it has ended; "" where the state says it all.
    history
        Its rows so far.
    began, ended
        The first and the last line of its log, "YYYY-MM-DD hh:mm:ss".
    ranks
        Of the last start.
    warnings
        In the order of the log.
    unloaded
        What the body was found from, where a loaded one was given.
    """

    state: str
    words: str
    history: HistoryColumns
    began: str
    ended: str
    ranks: str
    warnings: list[Warned]
    unloaded: str = ""

    @classmethod
    def of(cls, recording: RecordedRun) -> Story:
        """The story of a run's folder.

        Raises
        ------
        RecordingError, OSError
            If the folder is damaged or cannot be read.
        """
        lives = writer(recording.path)[1]
        history = recording.history
        lines = list(_log(recording.path))
        stamps = [stamp for stamp, _, _ in lines] or [""]
        ranks = [found[1] for _, _, text in lines if (found := _RANKS.match(text))] or [""]
        unloaded = [text for _, _, text in lines if text.startswith(SAID_UNLOADED)] or [""]
        state, words = _state(recording, history, lives)
        return cls(state, words, history, stamps[0], stamps[-1], ranks[-1], _warnings(lines), unloaded[-1])


def _log(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Stamp, level and text of each entry of the log, which may have several lines."""
    text = ""
    with suppress(FileNotFoundError):
        text = read_regular(folder / LOG, LARGEST_HISTORY).decode(errors="replace")
    entry: tuple[str, str, str] | None = None
    for line in text.splitlines():
        found = _LINE.fullmatch(line)
        if found is None:
            entry = entry and (*entry[:2], f"{entry[2]}\n{line}")
            continue
        if entry is not None:
            yield entry
        entry = found[1], found[2], found[3]
    if entry is not None:
        yield entry


def _warnings(lines: list[tuple[str, str, str]]) -> list[Warned]:
    found: dict[str, Warned] = {}
    time = ""
    for _, level, text in lines:
        step = _STEP.match(text)
        if level == "INFO" and step:
            time = step[1]
        if level not in ("WARNING", "ERROR", "CRITICAL"):
            continue
        first = found.setdefault(re.sub(r"\d+", "0", text), Warned(text, 0, time))
        first.count += 1
    return list(found.values())


def _state(recording: RecordedRun, history: HistoryColumns, lives: bool) -> tuple[str, str]:
    """A word, and why or where."""
    scene, times = recording.scene, history["time"]
    if len(times) and same_time(float(times[-1]), scene.last_time):
        return "finished", ""
    words = how_it_ended(recording.path)
    if words.startswith(FAILED):
        return "failed", words.removeprefix(FAILED)
    at = f"at t = {float(times[-1]) if len(times) else 0.0:g} of {scene.last_time:g}"
    if words.startswith(STOPPED):
        return "stopped", f"{at}: {words.removeprefix(STOPPED)}"
    if lives:
        of = f" of {scene.time.number_of_steps}" if scene.time.tolerance is None else ""
        return "running", f"step {max(0, len(times) - 1)}{of}, {at}"
    return "stopped", f"{at}, without a word: it was killed"
