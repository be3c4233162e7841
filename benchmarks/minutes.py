"""Measure how good a training with a time limit is: `refgs bench minutes --scenes DIR`.

Each scene is trained with time limits and no preset, and also with the presets `quick` and `standard`. The held-out PSNR of a run with a
time limit is compared with the PSNR that the presets had reached in the same time. Seconds are counted from the start of the command until
the result is written.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import Bench, Column, Table, Variant, figures, scene_options
from refgs.formats import history

PRESETS = "quick", "standard"
TABLES = (
    Table(
        "what a given time brings",
        "minutes",
        (
            Column("ended after s", "seconds", ".0f"),
            Column("iterations", "iterations", ",.0f"),
            Column("surfels", "surfels", ",.0f"),
            Column("PSNR dB", "psnr", ".2f"),
            Column("presets by then", "best_preset", ".2f"),
            Column("of", "preset", ""),
        ),
        variant="trained by",
    ),
)


def course(run: Path) -> list[tuple[float, float]]:
    """Read how a run's held-out PSNR grew over time. Return a list of pairs: seconds, PSNR.

    Seconds include all that the command does before and after the iterations.
    """
    found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    around = found["total_seconds"] - found["training_seconds"]
    return [(line["seconds"] + around, line["psnr_test"]) for line in _lines(run) if "psnr_test" in line]


def best(presets: dict[str, Path], seconds: float) -> tuple[float, str] | None:
    """Find which preset had reached the best PSNR after a number of seconds. Return this PSNR and the preset's name.

    `presets` maps names of presets to run folders. Return None if no run had measured its PSNR by then.
    """
    reached = [(psnr, name) for name, run in presets.items() for at, psnr in course(run) if at <= seconds]
    return max(reached, default=None)


def _lines(run: Path) -> list[dict]:
    return history.read(run / history.FILE)[0]


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and evaluate all runs that are not finished yet. Print the PSNR that each run reached, and the time that it took."""
    parser = scene_options(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--minutes", nargs="+", type=float, default=[2, 5, 10, 20])
    bench = Bench("minutes", parser, arguments)
    variants = {name: Variant(("--preset", name)) for name in PRESETS}
    variants |= {f"{minutes:g} minutes": Variant((), minutes) for minutes in bench.options.minutes}
    for scene, runs in bench.runs(variants):
        presets = {name: run for name, run in runs.items() if name in PRESETS}
        for variant, run in runs.items():
            seconds, psnr = course(run)[-1]
            reached, preset = (None if variant in PRESETS else best(presets, seconds)) or (None, None)
            bench.record(scene, variant, "s", seconds=seconds)
            bench.record(scene, variant, "", iterations=_lines(run)[-1]["iteration"], surfels=figures(run)["splats"])
            bench.record(scene, variant, "dB", psnr=psnr, best_preset=reached)
            bench.record(scene, variant, "", preset=preset)
    bench.finish(*TABLES)
