"""What is said to a user in one line, and the exit code of the command that ends with it: a leaf."""

from __future__ import annotations

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
