"""Run one of the benchmarks: `refgs bench WHAT [OPTIONS]`."""

import importlib
import sys

from benchmarks import BENCHMARKS
from refgs.errors import InputError


def main(what: str = "", *options: str) -> None:
    """Run a benchmark with its own options. Raise InputError with a list of the benchmarks if the name is unknown."""
    if what not in BENCHMARKS:
        raise InputError(f"no benchmark {what!r}: take one of {', '.join(BENCHMARKS)}")
    importlib.import_module(f"benchmarks.{what}").main(options)


if __name__ == "__main__":
    main(*sys.argv[1:])
