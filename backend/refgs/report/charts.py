"""Draw the charts of the report page as SVG, in the page's text colour."""

import io
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from refgs.report.curves import Curve, front, knee

INK = "#010203"  # replaced by the page's text colour, light or dark
ACROSS = 3  # charts in a row
LETTERS = 50  # letters of the legend that fit the width of one chart
PARTS = {  # parts of a run's time and their titles, in the order of the bar
    "raster": "raster",
    "shading": "shading",
    "prefilter": "prefilter of the light",
    "surfels": "surfels' values",
    "loss": "loss",
    "optimiser": "optimiser",
    "densification": "densification",
    "mesh": "mesh",
    "visibility": "visibility",
    "deciding": "finding out what is needed",
    "other": "Python, autograd",
    "reading": "reading",
    "start": "start",
    "writing": "writing",
    "measuring": "measuring",
    "FLIP": "measuring FLIP",
}


@contextmanager
def _drawing(width: float, height: float) -> Iterator[tuple[Figure, list[str]]]:
    """Yield a figure, sized in inches, and a list that gets its SVG afterwards."""
    style = {"svg.fonttype": "none", "svg.hashsalt": "refgs", "font.family": "sans-serif", "font.size": 10}
    style |= dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    style["text.parse_math"] = False  # runs' names may hold dollar signs
    made: list[str] = []
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, made
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    made.append(svg[svg.index("<svg") :].replace(INK, "currentColor"))


def _color(index: int) -> tuple[float, ...]:
    return matplotlib.colormaps["tab10"](index % 10)


def error_chart(groups: list[list[Curve]], runs: list[str]) -> str:
    """Draw a chart for each error measure, such as FLIP: error over seconds of training. Both axes are logarithmic.

    `groups` has a list of curves for each measure. `runs` are the labels of all runs; a run has the same colour in all charts. Returns SVG,
    or "" if `groups` is empty.
    """
    if not groups:
        return ""
    rows, columns = -(-len(groups) // ACROSS), min(len(groups), ACROSS)
    beside = max(1, LETTERS * columns // (6 + max(map(len, runs))))
    with _drawing(3.9 * columns, 2.9 * rows + 0.2 * (1 + (len(runs) + 2) // beside)) as (figure, made):
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, curves in zip(grid, groups, strict=False):
            _draw_errors(axes, curves, runs)
        for axes in grid[len(groups) :]:
            axes.axis("off")
        handles = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
        handles = dict(sorted(handles.items(), key=lambda item: item[0] not in runs))  # runs come first
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=beside, frameon=False, fontsize=9)
    return made[0]


def _draw_errors(axes: Axes, curves: list[Curve], runs: list[str]) -> None:
    for found in curves:
        number = runs.index(found.run)
        style = {"color": _color(number), "ls": "-" if number < 10 else "--", "lw": 1.8}
        axes.plot(found.seconds, found.errors, **style, marker="o", ms=2.5, label=found.run, gid="curve")
        if (at := knee(found)) is not None:
            place = found.seconds[at], found.errors[at]
            axes.plot(*place, "o", ms=9, mfc="none", mec=style["color"], mew=1.5, label="knee", gid="knee")
    on = np.concatenate(front(curves))
    seconds, errors = (np.concatenate([getattr(c, name) for c in curves])[on] for name in ("seconds", "errors"))
    order = np.argsort(seconds)
    axes.step(seconds[order], errors[order], color=INK, lw=0.8, ls=":", where="post", label="Pareto front", gid="front")
    axes.set(xscale="log", yscale="log", xlabel="seconds of training", facecolor="none")
    axes.set_title(curves[0].quantity.title, fontsize=10, loc="left")
    axes.grid(alpha=0.25, color=INK, lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):  # plain numbers, even within a decade
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 3 * low else range(1, 10)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def parts_chart(parts: dict[str, dict[str, float]]) -> str:
    """Draw a bar for each run: the seconds that it spent on each kind of work, such as shading or reading (see PARTS).

    `parts` is {run: {kind of work: seconds}}. Returns SVG, or "" if `parts` is empty.
    """
    if not parts:
        return ""
    with _drawing(11.7, 0.9 + 0.42 * len(parts)) as (figure, made):
        axes = figure.subplots()
        for number, (name, title) in enumerate(PARTS.items()):
            widths = [seconds.get(name, 0.0) for seconds in parts.values()]
            if not any(widths):
                continue
            before = [sum(seconds.get(n, 0.0) for n in list(PARTS)[:number]) for seconds in parts.values()]
            color = matplotlib.colormaps["tab20"](number % 20)
            axes.barh(list(parts), widths, left=before, color=color, height=0.62, label=title)
        axes.invert_yaxis()
        axes.set(xlabel="seconds", facecolor="none")
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(loc="outside upper left", ncols=8, frameon=False, fontsize=8.5)
    return made[0]
