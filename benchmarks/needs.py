"""Measure which parts of the method scenes do without, and how much time that saves: `refgs bench needs --scenes DIR`.

A need is a part of the method that a scene may do without.

Each scene is trained three times: with every need "auto" (decided by the photos), with every need on, and without inter-reflection.
Seconds are processor time, which other programs hardly change.
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
    """List the parts of the method that a run left out, as one text."""
    needs = json.loads((run / "needs.json").read_text(encoding="utf-8"))
    return ", ".join(need["need"] for need in needs if not need.get("needed", True))


def deciding(run: Path) -> float:
    """Compute the percentage of a run's seconds spent on deciding what the scene needs."""
    last = json.loads((run / "history.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    return 100 * last["parts"].get("deciding", 0.0) / last["seconds"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the missing runs; print the time that leaving out parts of the method saves, and the quality that it costs."""
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
