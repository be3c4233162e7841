"""Check and prepare this process at its start: its standard streams, arguments and current folder. Also end it by a signal."""

import errno
import io
import os
import signal
import sys
from typing import Any

from refgs.errors import InputError


class Output(io.RawIOBase):
    """Write to the stream `raw`, and drop what cannot be written, so that a full disk or a closed pipe does not stop the program.

    `error` is the last error, None if there was none. A closed pipe is not recorded as an error, because programs such as `head` close it
    early.
    """

    def __init__(self, raw: Any):
        self._raw = raw
        self.error: OSError | None = None

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._raw.fileno()

    def isatty(self) -> bool:
        return self._raw.isatty()

    def write(self, data: Any) -> int:
        """Write bytes, or drop them all. Returns how many were written or dropped."""
        try:
            return self._raw.write(data) or 0
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EINVAL):  # Windows reports an invalid argument for a closed pipe
                self.error = error
            return memoryview(data).nbytes


def open_streams() -> Output:
    """Make the standard streams safe to use. Returns the `Output` that the standard output writes to.

    A stream that was closed when the process started is opened as the null device. If it stayed closed, the next file that is opened would
    get the stream's number, and printed text would be written into that file. Characters that the terminal's encoding lacks, as in a path,
    are escaped.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
            os.set_inheritable(number, True)
    sys.stdout, output = _dropping(sys.stdout or os.fdopen(1, "w", closefd=False))
    sys.stderr, _ = _dropping(sys.stderr or os.fdopen(2, "w", closefd=False))
    sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr
    return output


def _dropping(stream: Any) -> tuple[io.TextIOWrapper, Output]:
    """Replace a text stream by one that drops unwritable text; return it and its `Output`."""
    encoding, lines = stream.encoding, stream.line_buffering or stream.write_through
    binary = stream.detach()
    output = Output(binary.detach() if isinstance(binary, io.BufferedWriter) else binary)
    return io.TextIOWrapper(io.BufferedWriter(output), encoding, "backslashreplace", line_buffering=lines), output


def check_current_folder() -> None:
    """Raise InputError if the current folder was deleted."""
    try:
        os.getcwd()
    except OSError:
        raise InputError(
            "the current folder is no longer there: change to another one, and run the command again"
        ) from None


def check_arguments() -> None:
    """Raise InputError if a command-line argument is not Unicode or cannot be decoded."""
    for word in sys.argv[1:]:
        try:
            word.encode()
        except UnicodeEncodeError:
            ascii_only = sys.getfilesystemencoding() == "ascii"
            mend = "choose a language with UTF-8 (LC_ALL=C.UTF-8)" if ascii_only else "rename the file or folder"
            raise InputError(f"{word}: this name is not Unicode: {mend}") from None


def terminate() -> None:
    """Send SIGTERM to this process, from any of its threads."""
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGTERM)  # os.kill would end the process there, without its handler
    else:
        os.kill(os.getpid(), signal.SIGTERM)  # wakes the main thread where it waits
