"""Run one of the benchmarks: `refgs bench WHAT [OPTIONS]`."""

import importlib
import sys

from benchmarks import BENCHMARKS
from refgs.errors import InputError


def main(what: str = "", *options: str) -> None:
    """Run the benchmark that is called `what`, with its `options`.

    Raise InputError if there is no such benchmark. The message lists all benchmarks.
    """
    if what not in BENCHMARKS:
        raise InputError(f"no benchmark {what!r}: take one of {', '.join(BENCHMARKS)}")
    importlib.import_module(f"benchmarks.{what}").main(options)


if __name__ == "__main__":
    main(*sys.argv[1:])
