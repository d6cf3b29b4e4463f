"""The bar of a run on a terminal: title, bar, step, state, time so far, time left on one line."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from rich.console import Console, RenderableType
from rich.constrain import Constrain
from rich.progress import BarColumn, Progress as RichProgress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

# a line that reaches the edge is broken by the ^C that a terminal shows, and then stands there twice
_MARGIN = 3


class Bar(RichProgress):
    """A bar on stderr. What others print stands above it; what goes to a file stays there."""

    def __init__(self, title: str, total: int | None, done: float):
        self._stderr = Console(stderr=True)
        super().__init__(
            _Cropped("title"),
            BarColumn(24),
            TextColumn("{task.fields[count]}"),
            _Cropped("state"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._stderr,
            refresh_per_second=4,
            redirect_stdout=sys.stdout.isatty(),
        )
        self._task = self.add_task("", total=total, title=title, count="", state="starting", left="")
        self.update(self._task, completed=done)

    def get_renderables(self) -> Iterator[RenderableType]:
        """The line, short of the terminal's edge."""
        yield Constrain(self.make_tasks_table(self.tasks), self._stderr.width - _MARGIN)

    def show(self, done: float, count: str, state: str, left: str) -> None:
        """Steps that are done, in words too, their time, iterations and loads, and the time that is left."""
        self.update(self._task, completed=done, count=count, state=state, left=left)

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(Text(text), soft_wrap=True)


class _Cropped(ProgressColumn):
    """A text of the task that loses its end where the terminal is narrow."""

    def __init__(self, name: str):
        super().__init__(Column())
        self.name = name

    def render(self, task: Task) -> Text:
        """The text."""
        return Text(task.fields[self.name], no_wrap=True, overflow="ellipsis")
