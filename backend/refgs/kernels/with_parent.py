"""Run a program that ends with its parent, even if the parent is killed: `python with_parent.py PROGRAM ARGUMENT…`.

The parent starts this script with a pipe as standard input. When the parent ends, the system closes the pipe. Then this script kills the
program and all processes that the program has started. On Windows, it kills only the program.
"""

import os
import signal
import subprocess
import sys
import threading


def main() -> None:
    """Run the program, and exit with its status."""
    if os.name == "posix":
        os.setsid()  # the group of all processes that are started below
    process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
    threading.Thread(target=_end_with_input, args=(process,), daemon=True).start()
    os._exit(process.wait())  # without waiting for the thread


def _end_with_input(process: subprocess.Popen) -> None:
    while os.read(0, 1024):
        pass
    if os.name == "posix":
        os.killpg(0, signal.SIGKILL)
    process.kill()
    os._exit(1)


if __name__ == "__main__":
    main()
