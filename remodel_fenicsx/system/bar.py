"""The bar of a run on a terminal: title, bar, step, state, time so far, time left on one line."""

from __future__ import annotations

import sys
from datetime import timedelta
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text


class Bar:
    """A bar on stderr, from the moment that it is made to `stop`.

    Parameters
    ----------
    title
        Name of the run.
    total, done
        Number of the last step, and how many were done before.
    """

    def __init__(self, title: str, total: int, done: int):
        # rich leads what others print, warnings of the log for one, around the bar; what goes to a file stays there
        console = Console(stderr=True)
        self._progress = Progress(
            _Line(console), console=console, refresh_per_second=4, redirect_stdout=sys.stdout.isatty()
        )
        self._task = self._progress.add_task(
            title, total=total, completed=done, time="starting", loads="", newton="", left=""
        )
        self._progress.start()

    def update(self, completed: int, **state: Any) -> None:
        """Steps that are done, and their `time`, `loads`, `newton` iterations and the time that is `left`, in words."""
        self._progress.update(self._task, completed=completed, **state)

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self._progress.console.print(Text(text), soft_wrap=True)

    def stop(self) -> None:
        """Leave the bar as it is, and the terminal to others."""
        self._progress.stop()


class _Line(ProgressColumn):
    """The whole line: title, bar, step, state, time so far, time left; what counts least goes where it is narrow."""

    _WIDEST_BAR, _NARROWEST_BAR = 24, 10
    _GAPS = 2  # one on each side of the bar
    # a line that reaches the edge is broken by the ^C that a terminal shows, and then stands there twice
    _MARGIN = 3

    def __init__(self, console: Console):
        super().__init__()
        self._console = console

    def render(self, task: Task) -> Table:
        """The line, for the terminal's present width."""
        title = task.description
        room = self._console.width - self._MARGIN - self._GAPS - cell_len(title)
        texts = [_behind_bar(task, extras) for extras in (4, 3, 2, 1, 0)]
        text = next((text for text in texts if cell_len(text) <= room - self._WIDEST_BAR), texts[-1])
        bar_width = min(self._WIDEST_BAR, max(self._NARROWEST_BAR, room - cell_len(text)))
        excess = bar_width + cell_len(text) - room
        if excess > 0:
            title = set_cell_size(title, max(0, cell_len(title) - excess - 1)) + "…"
        line = Table.grid(padding=(0, 1, 0, 0))
        line.add_row(Text(title), ProgressBar(task.total, task.completed, width=bar_width), Text(text, no_wrap=True))
        return line


def _behind_bar(task: Task, extras: int) -> str:
    """Step and time left, and so many of time, time so far, Newton iterations and loads."""
    shown = ("time", "elapsed", "newton", "loads")[:extras]
    values = (task.fields[name] for name in ("time", "loads", "newton") if name in shown)
    state = ", ".join(filter(None, values))
    elapsed = str(timedelta(seconds=int(task.elapsed or 0))) if "elapsed" in shown else ""
    number = f"{task.completed:.0f}/{task.total:.0f}"
    return " ".join(filter(None, [number, state, elapsed, task.fields["left"]]))
