"""Run the curves, print their rows, and write a chart and a table."""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.approximations import Row, directions, prefiltering, previews, raster, rays, shading, surfaces, textures
from benchmarks.approximations.chart import draw, write_table
from refgs.errors import InputError
from refgs.paths import clone_root

CURVES = {
    "split sum": shading.split_sum,
    "mirror rays": rays.mirror_rays,
    "prefilter cut-off": prefiltering.cut_off,
    "prefilter cells": prefiltering.cells,
    "prefilter levels": prefiltering.levels,
    "prefilter sides": prefiltering.sides,
    "cubemap": prefiltering.cubemaps,
    "harmonics": directions.degrees,
    "footprint": raster.footprint,
    "transmittance": raster.transmittance,
    "low-pass": raster.low_pass,
    "precision": raster.precision,
    "voxels": surfaces.voxels,
    "texture": textures.sizes,
    "previews": previews.samples,
}


def measured(only: str, console: Console) -> Iterator[Row]:
    """The rows of the curves whose name has the word in it, printed as they come."""
    for name, curve in CURVES.items():
        if only not in name:
            continue
        table = Table("approximation", "", "setting", "error", "unit", "±", "ms", "default", title=name)
        for row in curve():
            setting = row.setting if isinstance(row.setting, str) else f"{row.setting:g}"
            numbers = f"{row.error:.3g}", row.unit, f"{row.uncertainty:.1g}", f"{row.milliseconds:.3g}"
            table.add_row(row.approximation, row.method, setting, *numbers, "*" if row.default else "")
            yield row
        console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(prog="refgs bench approximations", description="Error against run time.")
    parser.add_argument("--only", default="", metavar="WORD", help=f"of the curves, those with it: {', '.join(CURVES)}")
    parser.add_argument("--out", type=Path, default=None, help="folder of the chart and the table")
    options = parser.parse_args()
    if not any(options.only in name for name in CURVES):
        raise InputError(f"--only {options.only}: take a word of {', '.join(CURVES)}")
    torch.set_num_threads(1)
    console = Console(width=max(Console().width, 140))
    rows = list(measured(options.only, console))
    out = options.out or clone_root() / "demo" / "approximations"
    out.mkdir(parents=True, exist_ok=True)
    draw(rows, out / "approximations.png")
    write_table(rows, out / "approximations.csv")
    console.print(f"Milliseconds of one thread. The chart and the table: {out}")


if __name__ == "__main__":
    main()
