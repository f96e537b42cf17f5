"""Errors a user can mend, told in one line."""


class UserError(Exception):
    """Something the caller can mend; the message is one line that says how.

    The command line prints the message without a traceback and exits with 2.
    """
