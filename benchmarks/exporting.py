"""A run's mesh, exported in a process of its own, whose memory can be told."""

import multiprocessing
import time
from itertools import pairwise
from pathlib import Path

from refgs import jobs


def export(folder: Path, target: Path, texture: int) -> dict:
    """Export a run's mesh in a process of its own: by stage the seconds that it took, and those of the processor; bytes at most."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_export, args=(folder, target, texture, theirs))
    process.start()
    theirs.close()
    try:
        return ours.recv()
    except EOFError:
        raise RuntimeError(f"{folder}: the export ended with status {process.exitcode}") from None
    finally:
        process.join()


def _export(folder: Path, target: Path, texture: int, results) -> None:
    marks = [("read", time.perf_counter(), time.process_time())]

    def report(event: str, facts: dict) -> None:
        if event == "stage":
            marks.append((facts["what"], time.perf_counter(), time.process_time()))

    jobs.export(folder, target, texture, None, None, True, report)
    marks.append(("", time.perf_counter(), time.process_time()))
    steps = [(what, after - before, used - had) for (what, before, had), (_, after, used) in pairwise(marks)]
    memory = [jobs.peak_memory(), jobs.peak_memory(children=True)]
    results.send({"steps": steps, "memory": memory})
