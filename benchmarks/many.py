"""Measure how long batches of many small captures take on some numbers of workers: `refgs bench many --out DIR`.

A batch has as many cores as workers, or all that there are if those are fewer. Its assets must be those of the first batch, bit for bit.
"""

import argparse
import json
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import Bench, Column, Table, call
from benchmarks.scenes.analytic import write_ball_capture
from refgs import CORES
from refgs.errors import InputError

SETTINGS = ("train.iterations=300", "surfels.start=800", "surfels.budget=800", "mesh.resolution=64")
MADE = ("splats.ply", "environment.exr", "mesh.glb", "cameras.json")
TABLE = Table(
    "many small captures",
    "many",
    (
        Column("wall s", "wall", ".1f"),
        Column("in commands s", "commands", ".1f"),
        Column("beyond them, s a step and worker", "beyond", ".2f"),
        Column("times as fast as the first", "speedup", ".2f"),
        Column("cores", "cores", ".0f"),
    ),
    line="workers",
)


def write_captures(folder: Path, count: int) -> Path:
    """Write captures of a ball, 28 photos of 64 pixels each, and a list of them with another seed for each. Return the list."""
    lines = [f'preset = "quick"\nset = {json.dumps(SETTINGS)}\n']
    for number in range(count):
        capture = folder / f"ball{number:02d}"
        if number:
            shutil.copytree(folder / "ball00", capture)
        else:
            capture.mkdir(parents=True)
            write_ball_capture(capture, 64, samples=1)
        lines.append(f'[[captures]]\nfolder = "{capture.name}"\nset = ["train.seed={number}"]\n')
    (folder / "list.toml").write_text("".join(lines))
    return folder / "list.toml"


def assets(runs: Path) -> dict[str, bytes]:
    """Read the assets of a batch, by their paths."""
    return {
        f"{run.parent.name}/{name}": (run.parent / name).read_bytes()
        for run in runs.glob("*/run.toml")
        for name in MADE
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a batch for each number of workers, and print what it took. Raises InputError if OUT has captures from before."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the captures and runs")
    parser.add_argument("--captures", type=int, default=24)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    bench = Bench("many", parser, arguments)
    out, cores = bench.options.out, sorted(os.sched_getaffinity(0))
    if (out / "captures").exists():
        raise InputError(f"{out} has captures from before: name a new folder")
    captures, expected, alone = write_captures(out / "captures", bench.options.captures), None, None
    for workers in bench.options.workers:
        runs, begun = out / f"{workers} workers", time.monotonic()
        os.sched_setaffinity(0, cores[:workers])  # which the batch inherits
        status = call("batch", captures, "--out", runs, "--workers", workers, "--device", "cpu")
        os.sched_setaffinity(0, cores)
        wall, made = time.monotonic() - begun, assets(runs)
        expected, alone = expected or made, alone or wall
        if status or made != expected:
            bench.failed.append(runs)
        steps = [json.loads(file.read_text())["seconds"] for file in (runs / "logs").glob("*/*.json")]
        beyond = (wall * min(workers, len(steps)) - sum(steps)) / len(steps)
        figures = {"wall": wall, "commands": sum(steps), "beyond": beyond, "speedup": alone / wall}
        bench.record(str(workers), "", "s", **figures, cores=min(workers, CORES))
    bench.finish(TABLE)
