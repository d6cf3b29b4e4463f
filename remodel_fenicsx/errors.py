"""What is said to a user in one line, and the exit code of the command that ends with it: a leaf."""

from __future__ import annotations

import re

LONGEST_MESSAGE = 900  # characters: of longer ones the ends are said
BAD_INPUT, SOLVE_FAILED, PAUSED, BAD_ENVIRONMENT = 2, 3, 4, 5


class RemodelError(Exception):
    """The base of all errors that are meant for a user: what is wrong stands in its one line.

    Attributes
    ----------
    exit_code : int
        Of a command that it ends (docs/commands.md): 2 for bad input, 3 for a solve that failed, and so on.
    on_all_ranks : bool
        Whether every rank of a run has it.

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
        """All that the command line says of it.

        Returns
        -------
        str
            One line.
        """
        return " ".join(str(self).split())


class UnreadableFile(RemodelError, ValueError):  # noqa: N818
    """What is wrong with a file of others; one line."""


class FigureError(RemodelError, ValueError):
    """No figure for a reason that its one line names."""

    def __init__(self, message: str, exit_code: int = BAD_INPUT):
        super().__init__(message)
        self.exit_code = exit_code


def printable(text: str) -> str:
    """Text on one line: control characters and line ends become spaces."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", text)


def shortened(text: str, most: int = LONGEST_MESSAGE) -> str:
    """A text without its middle where it is longer: its ends say where and why."""
    return text if len(text) <= most else f"{text[: most // 2 - 3]} ... {text[-(most // 2 - 2) :]}"
