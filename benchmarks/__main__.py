"""`refgs bench WHAT [OPTIONS]`: run one of the benchmarks."""

import importlib
import sys

from benchmarks import BENCHMARKS
from refgs.errors import InputError


def main(what: str = "", *options: str) -> None:
    """Run a benchmark with its own options. Raises InputError, with the list of them, where there is none of that name."""
    if what not in BENCHMARKS:
        raise InputError(f"no benchmark {what!r}: take one of {', '.join(BENCHMARKS)}")
    importlib.import_module(f"benchmarks.{what}").main(options)


if __name__ == "__main__":
    main(*sys.argv[1:])
