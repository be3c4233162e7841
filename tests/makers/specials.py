"""Read pipes, sockets, devices and files with a hole in the place of every kind of file, in a process of its own.

    python -c "from tests.makers.specials import run; run()" FOLDER [READER …]

FOLDER gets a file `found.jsonl` with a line for each reader and each such file: what happened if it is neither success nor an InputError of
one line, the seconds of the processor, and the bytes of memory.
"""

import json
import os
import resource
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from tests.makers import fuzz
from tests.makers.mutants import put_link
from tests.makers.readers import READERS

HOLE = 30 << 30  # bytes of a file with a hole: more than any machine of ours has memory
# Their readers in `readers` read the file as a whole before the trainer does, or it is no file but a stream.
READ_BY_THE_TEST = ("photos that are cached", "--set", "commands of a worker")
PATIENCE = 60  # seconds until a reader is taken to wait for ever


def _hole(file: Path, sample: bytes) -> None:
    file.write_bytes(sample)
    os.truncate(file, HOLE)


KINDS: dict[str, Callable[[Path, bytes], object]] = {
    "a pipe": lambda file, sample: put_link(file, "fifo"),
    "a socket": lambda file, sample: put_link(file, "socket"),
    "a device": lambda file, sample: put_link(file, "/dev/zero"),
    "a file of the system": lambda file, sample: put_link(file, "/proc/self/pagemap"),
    "a folder": lambda file, sample: put_link(file, ""),
    "a hole": _hole,
}


class Waits(BaseException):
    pass


def _stop(*_) -> None:
    raise Waits(f"waits for more than {PATIENCE} seconds")


def run() -> None:
    """Read them all. The names of readers on the command line limit which."""
    folder, names = Path(sys.argv[1]), sys.argv[2:] or [*READERS]
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _stop)
    with open(folder / "found.jsonl", "a") as found:
        for name in names:
            reader, place = READERS[name], folder / "sample"
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            fuzz.remove(place)
            place.mkdir()
            reader.make(place)
            file = place / reader.file
            sample = file.read_bytes()
            reader.read(place)  # loads what is loaded late
            fuzz.limit_memory()
            for kind, put in KINDS.items():
                fuzz.remove(file)
                put(file, sample)
                fuzz.forget_peak()
                known, before = fuzz.memory("VmRSS"), time.process_time()
                signal.alarm(PATIENCE)
                said = fuzz.verdict(reader, place)
                signal.alarm(0)
                took, bytes_ = time.process_time() - before, fuzz.memory("VmHWM") - known
                facts = {"reader": name, "kind": kind, "said": said, "seconds": round(took, 2), "bytes": bytes_}
                found.write(json.dumps(facts) + "\n")
                found.flush()
            fuzz.remove(file)
