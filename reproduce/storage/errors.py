"""Two kinds of error that a command reports in one line, without a traceback."""


class UserError(Exception):
    """What the user can mend (exit code 2): says what was wrong, where, what was expected and what came."""


class RunFailedError(Exception):
    """Something that a command started did not end well (exit code 1)."""


class StoppedError(Exception):
    """A signal ended a command; one line says what was kept and how to go on, exit code 128 plus the signal."""
