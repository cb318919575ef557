"""The one exception that users are meant to read."""

import contextlib
from collections.abc import Iterator


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is a sentence with four parts: what was expected, what came, in which file, what
    to do. The command line prints it without a traceback and exits with status 2.
    """


@contextlib.contextmanager
def explain_faults(expected: str) -> Iterator[None]:
    """Within the block, what Python raises for a document of another form becomes an InputError.

    expected: what the block reads and where, such as `cameras.json of this workflow in PATH`
    For files that the workflow made: the sentence ends with "delete it and run again".
    """
    try:
        yield
    except InputError:
        raise
    except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
        raise InputError(f"expected {expected}, got {error!r}: delete it and run again") from None
