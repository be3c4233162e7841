"""Read damaged files of every kind in a process of its own, and report what is no success and no InputError of one line.

    python -m tests.makers.fuzz FOLDER COUNT SEED [START]

`COUNT` inputs are shared out to the readers of `tests.makers.readers`. FOLDER gets a file `at` with the number of the input that is being
read, so that whoever waits can tell a crash or a hang; and `found.jsonl` with a line for each failure, for each slow input, and for each
reader that is done.
"""

import json
import os
import random
import resource
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

from refgs.errors import InputError
from tests.makers.mutants import LINKS, damage_folder, mutant, put_link
from tests.makers.readers import READERS, Reader

MOST = 1 << 30  # bytes of memory for an input
ADDRESSES = 6 << 30  # bytes that may be reserved for it: some readers reserve more than they use
SLOW = 2.0  # seconds of the processor for an input
DONE = -1  # the number of the input that is being read, after the last


def plan(count: int) -> Iterator[tuple[str, int]]:
    """Share `count` inputs out to the readers. Yields the name of each reader and the number of its inputs, at least 2."""
    total = sum(reader.share for reader in READERS.values())
    for name, reader in READERS.items():
        yield name, max(2, round(count * reader.share / total))


def describe(count: int, seed: str, number: int) -> dict[str, str]:
    """Name the reader of an input by the input's number, and the seed of its damage."""
    for name, tries in plan(count):
        if number < tries:
            return {"reader": name, "seed": f"{seed} {name} {number}"}
        number -= tries
    raise IndexError(number)


def damage(file: Path, sample: bytes, kind: str, seed: str) -> None:
    """Put a damaged sample, or a folder or link, in the place of a file. The same seed gives the same damage.

    If `kind` is "folder", damage the folder `file` instead, which is first copied anew from `file` with the suffix ".whole".
    """
    dice = random.Random(seed)
    remove(file)
    if kind == "folder":
        shutil.copytree(file.with_suffix(".whole"), file)
        damage_folder(file, dice)
        return
    if dice.random() < 0.01:
        put_link(file, dice.choice(LINKS))
    else:
        file.write_bytes(mutant(sample, kind, dice))


def remove(file: Path) -> None:
    """Remove a file, link or folder if there is one."""
    if file.is_dir() and not file.is_symlink():
        shutil.rmtree(file)
    else:
        file.unlink(missing_ok=True)


def verdict(reader: Reader, folder: Path) -> str | None:
    """Read a damaged file. Return None if that succeeds or ends in an InputError of one line, otherwise what happened instead."""
    try:
        reader.read(folder)
    except InputError as error:
        said = str(error)
        return None if said and len(said.splitlines()) == 1 else f"InputError of {len(said.splitlines())} lines: {said}"
    except BaseException as error:
        if isinstance(error, MemoryError):
            return "MemoryError"
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]} ({Path(last.filename).name}:{last.lineno} {last.name})"
    return None


def limit_memory() -> None:
    """Let this process reserve no more than ADDRESSES bytes besides those that it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def memory(which: str) -> int:
    """Return the bytes of memory that this process has ("VmRSS"), or the most that it had since `forget_peak` ("VmHWM")."""
    return 1024 * int(Path("/proc/self/status").read_text().partition(f"{which}:")[2].split()[0])


def forget_peak() -> None:
    """Let the most memory that this process had be what it has now (Linux's proc(5), clear_refs)."""
    Path("/proc/self/clear_refs").write_text("5")


def main(folder: Path, count: int, seed: str, start: int) -> None:
    """Read the inputs from the number `start` on."""
    warnings.simplefilter("ignore")
    number = 0
    with open(folder / "found.jsonl", "a") as found, open(folder / "at", "r+b", buffering=0) as at:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(folder / "stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)

        def tell(**facts) -> None:
            found.write(json.dumps(facts) + "\n")
            found.flush()

        for name, tries in plan(count):
            if number + tries <= start:
                number += tries
                continue
            reader, place = READERS[name], folder / "sample"
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            remove(place)
            place.mkdir()
            reader.make(place)
            file = place / reader.file
            if reader.kind == "folder":
                shutil.copytree(file, file.with_suffix(".whole"))
            sample = b"" if reader.kind == "folder" else file.read_bytes()
            reader.read(place)  # valid; and loads what is loaded late
            limit_memory()
            begun, slowest = time.process_time(), 0.0
            for i in range(tries):
                if number + i < start:
                    continue
                at.seek(0)
                at.write(b"%-12d" % (number + i))
                damage(file, sample, reader.kind, f"{seed} {name} {i}")
                forget_peak()
                known, before = memory("VmRSS"), time.process_time()
                said = verdict(reader, place)
                took = time.process_time() - before
                if memory("VmHWM") - known > MOST:
                    said = f"took {(memory('VmHWM') - known) / 2**30:.1f} GB"
                slowest = max(slowest, took)
                if said:
                    tell(reader=name, seed=f"{seed} {name} {i}", failure=said)
                if took > SLOW:
                    tell(reader=name, seed=f"{seed} {name} {i}", slow=round(took, 1))
            number += tries
            remove(file)
            tell(reader=name, tries=tries, seconds=round(time.process_time() - begun, 2), slowest=round(slowest, 2))
        at.seek(0)
        at.write(b"%-12d" % DONE)


def run() -> None:
    """Call `main` with the arguments of the command line."""
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]) if len(sys.argv) > 4 else 0)


if __name__ == "__main__":
    run()
