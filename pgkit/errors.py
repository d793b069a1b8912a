"""The one error that is the user's to mend."""


class UserError(ValueError):
    """Wrong input. The message is one line: what is wrong, where, and what to do.

    The command line prints ``error: <message>`` and exits with 2; every other exception keeps its traceback.
    """
