"""Measure how much time is saved by leaving out the optional parts that a scene does not need: `refgs bench needs --scenes DIR`.

A "need" is an optional part of the method, such as inter-reflection. By default, a training decides from the photos which needs the scene
has. Each scene is trained three times: with this default, with all needs switched on, and without inter-reflection. All times are CPU
times, because other programs on the machine hardly change these.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import Bench, Column, Table, Variant, figures, relit, scene_options
from refgs.settings import NeedsSettings

ON, AUTO, OFF = "all on", "auto", "no reflections"
CHANGES = {
    ON: (*(f"needs.{name}=on" for name in NeedsSettings.model_fields), "indirect.least=0"),
    AUTO: (),
    OFF: ("needs.reflections=off",),
}
TABLES = (
    Table(
        "what scenes do without",
        "needs",
        (
            Column("all on: CPU s", "seconds", ".0f", ON),
            Column("as decided", "seconds", ".0f", AUTO),
            Column("times as fast", "times_as_fast", ".2f", AUTO),
            Column("deciding %", "deciding", ".1f", AUTO),
            Column("all on: PSNR dB", "psnr", ".2f", ON),
            Column("as decided", "psnr", ".2f", AUTO),
            Column("relit, aligned: all on", "relit_aligned", ".1f", ON),
            Column("as decided", "relit_aligned", ".1f", AUTO),
            Column("left out", "left_out", "", AUTO),
        ),
    ),
    Table(
        "without inter-reflection",
        "needs",
        (
            Column("PSNR dB", "psnr", ".2f", OFF),
            Column("times as fast as all on", "times_as_fast", ".2f", OFF),
        ),
    ),
)


def left_out(run: Path) -> str:
    """Return the names of the optional parts of the method that a run left out, separated by commas."""
    needs = json.loads((run / "needs.json").read_text(encoding="utf-8"))
    return ", ".join(need["need"] for need in needs if not need.get("needed", True))


def deciding(run: Path) -> float:
    """Return which percentage of a run's time was spent on deciding which optional parts of the method the scene needs."""
    last = json.loads((run / "history.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    return 100 * last["parts"].get("deciding", 0.0) / last["seconds"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and evaluate all runs that are not finished yet.

    Print how much time was saved by leaving out optional parts of the method, and how much quality was lost.
    """
    parser = scene_options(argparse.ArgumentParser(description=__doc__.splitlines()[0]), preset="quick")
    bench = Bench("needs", parser, arguments)
    preset = ("--preset", bench.options.preset)
    variants = {
        variant: Variant((*preset, *(word for c in changes for word in ("--set", c))))
        for variant, changes in CHANGES.items()
    }
    for scene, runs in bench.runs(variants):
        everything = figures(runs[ON])["processor_seconds"] if ON in runs else None
        for variant, run in runs.items():
            found = figures(run)
            seconds = found["processor_seconds"]
            bench.record(scene, variant, "s", seconds=seconds)
            bench.record(scene, variant, "", times_as_fast=everything and everything / seconds, left_out=left_out(run))
            bench.record(scene, variant, "%", deciding=deciding(run))
            bench.record(scene, variant, "dB", psnr=found["psnr"], relit_aligned=relit(found, "psnr_aligned"))
            bench.record(scene, variant, "°", normals=found.get("normal_mae_degrees"))
            bench.record(scene, variant, "GB", memory=found.get("peak_memory_bytes", 0) / 1e9)
    bench.finish(*TABLES)
