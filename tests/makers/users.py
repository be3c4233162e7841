"""Run code as another user of the machine."""

import os
from collections.abc import Callable

NOBODY = 65534  # a user and a group that every Linux has


def as_nobody(work: Callable[[], object]) -> str:
    """Call `work` in a process of the user `nobody`. Return what it returns, or the type and message of the error that it raises.

    The caller must be root. `work` must not need a file that only root can read.
    """
    source, sink = os.pipe()
    if (child := os.fork()) == 0:
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            said = str(work())
        except BaseException as error:
            said = f"{type(error).__name__}: {error}"
        os.write(sink, said.encode())
        os._exit(0)
    os.close(sink)
    with open(source, "rb") as opened:
        said = opened.read().decode()
    os.waitpid(child, 0)
    return said
