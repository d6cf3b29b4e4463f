"""Terminal and log of a run: progress bar or plain lines, and run.log. Only rank 0 prints."""

from __future__ import annotations

import logging
import math
import os
import sys
import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import TYPE_CHECKING, Self, cast

from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.system.files import open_own

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

LOGGER = "remodel_fenicsx"
LOG_FORMAT = "%(asctime)s %(levelname)s %(message)s"
LINE_EVERY = 10.0  # seconds between plain lines


class Progress:
    """Progress of a run on stderr: a bar on a terminal, otherwise a plain line at intervals."""

    def __init__(
        self,
        total_steps: int,
        title: str,
        silent: bool = False,
        *,
        interval: float = 25.0,
        done: float = 0,
    ):
        self._total, self._title = total_steps, title
        self._done = done
        self._silent, self._interval = silent, interval
        self._line_is_due = -math.inf
        # First step and its clock time; the estimate excludes compilation.
        self._first: tuple[float, float] | None = None
        self._bar: RichProgress | None = None  # on a terminal only

    def __enter__(self) -> Self:
        if not self._silent and _is_terminal():
            self._bar = _bar(self._title, self._total or None, self._done)
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            with suppress(OSError):  # The terminal is closed.
                self._bar.stop()
            self._bar = None

    def step(self, index: float, state: str, count: str | None = None) -> None:
        """Show that step `index` (at most total_steps; may be fractional) is done."""
        if self._silent:
            return
        count, left = count or f"{index}/{self._total}", self._time_left(index)
        if self._bar is not None:
            self._bar.update(
                self._bar.task_ids[0], completed=index, count=count, state=state, left=left
            )
        else:
            said = f"step {count}", state, left
            self._say(", ".join(filter(None, said)), at_once=index >= self._total)

    def show(self, text: str) -> None:
        """Show a line; plain lines appear at intervals only."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], state=text)
        elif not self._silent:
            self._say(text, at_once=False)

    def _say(self, text: str, at_once: bool) -> None:
        """Print a plain line if one is due."""
        if at_once or clock.monotonic() >= self._line_is_due:
            announce(f"{self._title}: {text}")
            self._line_is_due = clock.monotonic() + self._interval

    def _time_left(self, index: float) -> str:
        """Estimate the remaining time from the mean time per step after the first one."""
        now, remaining = clock.monotonic(), self._total - index
        self._first = first, since = self._first or (index, now)
        if index <= first or remaining <= 0:
            return ""
        return f"{duration((now - since) / (index - first) * remaining)} left"


class Line(Progress):
    """Progress of several runs on stderr: one changing line, or plain lines at intervals."""

    def __init__(self, title: str, silent: bool) -> None:
        super().__init__(0, title, silent, interval=LINE_EVERY)


def _bar(title: str, total: int | None, done: float) -> RichProgress:
    """Make a rich progress bar: title, bar, step, state, elapsed and remaining time on one line."""
    from rich.console import Console  # Imported late because most runs have no terminal.
    from rich.progress import BarColumn, Progress as RichProgress, TimeElapsedColumn

    console = Console(stderr=True, markup=False, highlight=False)
    # The ^C that a terminal echoes would break a line of full width and leave a copy of it.
    console.width -= 3
    bar = RichProgress(
        "{task.description}",
        BarColumn(24),
        "{task.fields[count]}",
        "{task.fields[state]}",
        TimeElapsedColumn(),
        "{task.fields[left]}",
        console=console,
        refresh_per_second=4,
        redirect_stdout=sys.stdout.isatty(),
    )
    bar.update(
        bar.add_task(title, total=total, count="", state="starting", left=""), completed=done
    )
    return bar


def _is_terminal() -> bool:
    return (
        sys.stderr is not None
        and sys.stderr.isatty()
        and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")
    )


def announce(line: str) -> None:
    """Print a line on stderr; ignore a closed pipe, which must not end a long run."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


@contextmanager
def buffer_log(comm_rank: int = 0, *, quiet: bool = True) -> Iterator[list[logging.LogRecord]]:
    """Buffer log records until the run has a folder (`open_log`); show terminal lines directly."""
    early = MemoryHandler(sys.maxsize, flushLevel=sys.maxsize, flushOnClose=False)
    with _logged_to([early, _StderrHandler(quiet)], comm_rank):
        yield early.buffer


@contextmanager
def open_log(
    path: str | os.PathLike[str],
    comm_rank: int = 0,
    *,
    quiet: bool = True,
    held: Sequence[logging.LogRecord] = (),
) -> Iterator[logging.Logger]:
    """Append the package's log records with times to `path`, and print warnings on the terminal."""
    handlers: list[logging.Handler] = []
    if comm_rank == 0:
        file = _LogFile(path, encoding="utf-8")
        file.setFormatter(logging.Formatter(LOG_FORMAT))
        handlers = [file, _StderrHandler(quiet)]
        for record in held:
            file.handle(record)
    with _logged_to(handlers, comm_rank) as logger:
        yield logger


@contextmanager
def _logged_to(handlers: list[logging.Handler], comm_rank: int) -> Iterator[logging.Logger]:
    """Send the package log and Python warnings to handlers on rank 0, elsewhere to none."""
    logger, python_warnings = logging.getLogger(LOGGER), logging.getLogger("py.warnings")
    handlers = handlers if comm_rank == 0 else [logging.NullHandler()]
    before = logger.level, logger.propagate, python_warnings.propagate
    logger.setLevel(logging.INFO)
    logger.propagate = python_warnings.propagate = False
    for handler in handlers:
        logger.addHandler(handler)
        python_warnings.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield logger
    finally:
        logging.captureWarnings(False)
        for handler in handlers:
            logger.removeHandler(handler)
            python_warnings.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate, python_warnings.propagate = before[1:]
        for handler in handlers:
            handler.close()  # last, because a full disk raises here


class _LogFile(logging.FileHandler):
    """Log file that raises on write errors and follows no link."""

    def _open(self) -> TextIOWrapper:
        descriptor = open_own(Path(self.baseFilename), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        return cast(TextIOWrapper, open(descriptor, "a", encoding=self.encoding))

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).rstrip()  # Python's warnings end in a newline.

    def handleError(self, record: logging.LogRecord) -> None:
        # logging calls this inside its own `except`; its default prints a traceback for every line
        # and continues.
        raise


class _StderrHandler(logging.Handler):
    """Handler for the present stderr: while a bar is shown, rich's stream prints above it."""

    def __init__(self, quiet: bool):
        super().__init__(logging.WARNING if quiet else NOTICE)

    def emit(self, record: logging.LogRecord) -> None:
        level = "" if record.levelno == NOTICE else f"{record.levelname}: "
        announce(level + self.format(record).rstrip())


def duration(seconds: float) -> str:
    """Format a duration: 42 s, 3:05 min, 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


@contextmanager
def muted_warnings() -> Iterator[None]:
    """Mute warnings of intermediate runs; the final run repeats them."""
    package = logging.getLogger(LOGGER)
    before = package.level
    package.setLevel(logging.ERROR)
    try:
        yield
    finally:
        package.setLevel(before)
