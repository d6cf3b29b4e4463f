"""Errors for users, in one line, with the exit code of the command."""

from __future__ import annotations

import re

LONGEST_MESSAGE = 900  # characters; longer messages lose their middle
BAD_INPUT, SOLVE_FAILED = 2, 3
PAUSED, BAD_ENVIRONMENT = 4, 5


class RemodelError(Exception):
    """Base class of all errors for users, with a message of one line.

    Attributes
    ----------
    exit_code : int
        Exit code of the command (docs/commands.md): 2 for invalid input, 3 for a failed solve, and
        so on.
    on_all_ranks : bool
        Whether the error is raised on every rank of a run.

    Examples
    --------
    >>> from remodel_fenicsx import Recording, RemodelError
    >>> try:
    ...     Recording("no-such-folder")
    ... except RemodelError as error:
    ...     print(error.in_words(), error.exit_code)
    no-such-folder: there is no such folder 2
    """

    exit_code = BAD_INPUT
    on_all_ranks = True

    def in_words(self) -> str:
        """Return the whole message of the command line.

        Returns
        -------
        str
            One line.
        """
        return " ".join(str(self).split())


class UnreadableFile(RemodelError, ValueError):  # noqa: N818
    """Error of an untrusted file, with a message of one line."""


class FigureError(RemodelError, ValueError):
    """Error that prevents a figure, with a message of one line."""

    def __init__(self, message: str, exit_code: int = BAD_INPUT):
        super().__init__(message)
        self.exit_code = exit_code


def printable(text: str) -> str:
    """Return text on one line: control characters and line ends become spaces."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", text)


def shortened(text: str) -> str:
    """Return the text, without its middle if it is too long: its ends have position and reason."""
    half = LONGEST_MESSAGE // 2
    if len(text) <= LONGEST_MESSAGE:
        return text
    return f"{text[: half - 3]} ... {text[2 - half :]}"
