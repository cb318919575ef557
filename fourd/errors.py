"""The one exception that users are meant to read."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is a sentence with four parts: what was expected, what came, in which file, what
    to do. The command line prints it without a traceback and exits with status 2.
    """
