"""Define errors and warnings about the user's input."""

import re

TRY_AGAIN = 75
"""Exit status of a command that may succeed if it is repeated: EX_TEMPFAIL of sysexits.h, which schedulers know."""

# Control characters, line separators and lone surrogates: names of files may hold them.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def one_line(message: object) -> str:
    """Return a message as one printable line, with unprintable characters such as newlines escaped."""
    return _UNPRINTABLE.sub(lambda found: repr(found[0])[1:-1], str(message))


class InputError(Exception):
    """Error in the user's input.

    The message is one line for the user: what is wrong, where, and what to do. The command line prints only this line and exits with status
    2. Any other exception is a bug of the program: the command line prints its traceback and exits with status 1. A training also writes
    the traceback to log.txt in the run folder.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class TryAgain(InputError):
    """Error that is not the input's fault: a full disk, a GPU that fails, a run folder that another process is using.

    The same command may succeed later. The command line exits with the status TRY_AGAIN.
    """


class NoCameras(InputError):
    """Error for a folder that has photos but no cameras. `refgs.capture.motion` can find the cameras."""


class InputWarning(UserWarning):
    """Report in one line that part of the user's input was wrong and ignored."""


def reason(error: Exception) -> str:
    """Return a library error's message, cut short, or the error's type if empty."""
    return " ".join(str(error).split())[:120] or type(error).__name__
