"""The one kind of error that is the user's to mend: one line, exit code 2."""


class UserError(Exception):
    """Says what was wrong, where, and what was expected."""


class RunFailedError(Exception):
    """Something that was started did not end well; one line, exit code 1."""
