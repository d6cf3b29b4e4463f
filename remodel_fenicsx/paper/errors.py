"""Why there is no figure."""


class FigureError(Exception):
    """No figure for a reason that its one line names; `exit_code` is the command's."""

    def __init__(self, message: str, exit_code: int):
        super().__init__(message)
        self.exit_code = exit_code
