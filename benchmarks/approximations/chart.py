"""Rows as charts and as a table."""

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from benchmarks.approximations import Row
from refgs.paths import whole

COLUMNS = 4
COLORS = matplotlib.colormaps["tab10"].colors


def draw(rows: Sequence[Row], path: Path) -> None:
    """A chart an approximation, error against milliseconds, both logarithmic, as PNG. A ring is a default. What is exact lies on the
    lower edge; what has no time is left out."""
    names = list(dict.fromkeys(row.approximation for row in rows))
    down = -(-len(names) // COLUMNS)
    with matplotlib.rc_context({"font.size": 8, "axes.titlesize": 9}):
        figure = Figure(figsize=(4 * COLUMNS, 3.1 * down), layout="constrained", dpi=80)
        for place, name in enumerate(names):
            _chart(
                figure.add_subplot(down, COLUMNS, place + 1), name, [row for row in rows if row.approximation == name]
            )
        with whole(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def _chart(axes, name: str, rows: list[Row]) -> None:
    rows = [row for row in rows if np.isfinite(row.milliseconds)]
    shown: list[tuple[float, float]] = []
    floor = min((row.error for row in rows if row.error > 0), default=1.0) / 3
    for index, method in enumerate(dict.fromkeys(row.method for row in rows)):
        color, line = COLORS[index], [row for row in rows if row.method == method]
        points = [(row.milliseconds, max(row.error, floor)) for row in line]
        shown += points
        joined = "-" if all(isinstance(row.setting, int | float) for row in line) else ""
        axes.plot(*zip(*points, strict=True), joined, marker="o", ms=3, lw=1, color=color, label=method)
        for row, point in zip(line, points, strict=True):
            text = row.setting if isinstance(row.setting, str) else f"{row.setting:g}"
            axes.annotate(text, point, xytext=(3, 3), textcoords="offset points", color=color, fontsize=7)
            if row.default:
                axes.plot(*point, "o", ms=9, mfc="none", mec="black", mew=1.2)
    axes.set(title=name, xscale="log", yscale="log", xlabel="milliseconds", ylabel=rows[0].unit if rows else "")
    for axis, values in zip((axes.xaxis, axes.yaxis), np.transpose(shown), strict=True):
        if np.max(values) < 100 * np.min(values):  # plain numbers where there is hardly a decade
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.margins(0.18)
    axes.grid(alpha=0.3, lw=0.5)
    if any(row.method for row in rows):
        axes.legend(frameon=False, fontsize=7)


def write_table(rows: Sequence[Row], path: Path) -> None:
    """The rows as CSV, with a line of headings."""
    with whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(Row._fields)
        for row in rows:
            table.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in row])
