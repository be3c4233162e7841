"""Analyse curves of error against run time: Pareto fronts, knees, times to given errors.

Errors and times are compared by their logarithms, so that a 10 % change counts the same everywhere.
"""

import csv
import io
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from refgs.report.figures import flatten, is_number

LEVELS = 6  # errors in a table of times, approximately
LEAST_KNEE = 0.1  # of the chord's height; a curve that bends less has no knee


class Quantity(NamedTuple):
    """Error measure in history.jsonl: its key, its title, and its unit. Smaller errors are better.

    With `decibels` the value is a PSNR in dB, which is −20 log₁₀ of the RMS error for a peak of 1.
    """

    key: str
    title: str
    decibels: bool = False

    def error(self, value: float) -> float:
        return 10 ** (-value / 20) if self.decibels else value

    def text(self, error: float) -> str:
        """Format an error as text. If the quantity is a PSNR, the text is in decibels."""
        return f"{-20 * np.log10(error):.4g} dB" if self.decibels else f"{error:.3g}"


QUANTITIES = (
    Quantity("psnr_test", "held-out views: RMS error", True),
    Quantity("flip_test", "held-out views: FLIP"),
    Quantity("normal_mae_degrees", "normals: mean angle, degrees"),
    Quantity("light_log_rmse", "light: RMS error of log radiance"),
    Quantity("relit_psnr", "under another light: RMS error", True),
    Quantity("albedo_psnr", "base colour: RMS error", True),
    Quantity("roughness_mae", "roughness: mean error"),
    Quantity("metallic_mae", "metallic: mean error"),
    Quantity("psnr_train", "training views: RMS error", True),
    Quantity("loss", "training loss"),
)


class Curve(NamedTuple):
    """Errors of a run against its seconds of training, (n,) each, ascending in time."""

    run: str
    quantity: Quantity
    iterations: np.ndarray
    seconds: np.ndarray
    errors: np.ndarray


def curve(run: str, history: list[dict], quantity: Quantity) -> Curve:
    """Make the curve of a quantity from a history. Lines without the quantity, or without a logarithm of it, are skipped."""
    found = [
        (line.get("iteration", 0), line["seconds"], quantity.error(line[quantity.key]))
        for line in history
        if is_number(line.get(quantity.key)) and line["seconds"] > 0
    ]
    rows = np.array(sorted((row for row in found if row[2] > 0), key=lambda row: row[1]), dtype=float).reshape(-1, 3)
    return Curve(run, quantity, *rows.T)


def front(curves: list[Curve]) -> list[np.ndarray]:
    """Mark the points of each curve (n,) that lie on the Pareto front of all curves.

    A point is on the front if no other point has a smaller error in at most the same time, or at most the same error in less time.
    """
    seconds, errors = (np.concatenate([getattr(c, name) for c in curves]) for name in ("seconds", "errors"))
    order = np.lexsort((errors, seconds))
    best = np.minimum.accumulate(np.concatenate([[np.inf], errors[order]]))[:-1]
    on = np.zeros(len(errors), dtype=bool)
    on[order] = errors[order] < best
    return np.split(on, np.cumsum([len(c.errors) for c in curves])[:-1])


def knee(found: Curve) -> int | None:
    """Find the knee of a curve, after which more time brings little (Kneedle, Satopää et al. 2011, without smoothing).

    The knee is the point of the best error so far that lies furthest below the chord from the first point to the best; both axes are
    logarithms scaled to 0..1. Returns None for fewer than five points, and for a bend below LEAST_KNEE: a power law is a straight line.
    """
    if len(found.errors) < 5:
        return None
    x, y = np.log(found.seconds), np.log(np.minimum.accumulate(found.errors))
    if x[-1] <= x[0] or y[-1] >= y[0]:
        return None
    below = 1 - (x - x[0]) / (x[-1] - x[0]) - (y - y[-1]) / (y[0] - y[-1])
    at = int(below.argmax())
    return at if below[at] >= LEAST_KNEE else None


def time_to(found: Curve, error: float) -> float | None:
    """Return the seconds after which the curve `found` first has at most this error, or None if it never has.

    Between two points of the curve, the logarithms of seconds and error are interpolated linearly.
    """
    reached = np.flatnonzero(found.errors <= error)
    if not len(reached):
        return None
    at = reached[0]
    if at == 0:
        return float(found.seconds[0])
    x, y = np.log(found.seconds[at - 1 : at + 1]), np.log(found.errors[at - 1 : at + 1])
    return float(np.exp(x[0] + (np.log(error) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def levels(curves: list[Curve]) -> list[float]:
    """Choose a few round errors that the curves pass, the largest first. If the quantity is a PSNR, they are round in decibels."""
    quantity = curves[0].quantity
    worst, best = max(c.errors[0] for c in curves), min(c.errors.min() for c in curves)
    if best >= worst:
        return []
    ends = sorted(-20 * np.log10(e) if quantity.decibels else e for e in (worst, best))
    rounded = MaxNLocator(nbins=LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(*ends)
    inside = [quantity.error(float(x)) for x in rounded if ends[0] < x <= ends[1] or x == ends[0]]
    return sorted((e for e in inside if best <= e < worst), reverse=True)


def as_csv(histories: dict[str, list[dict]], groups: list[list[Curve]]) -> str:
    """Write the figures of the charts and tables as CSV: run, iteration, seconds, quantity, value, mark.

    Each point of a curve has a row. It is marked "front" on the Pareto front, and "knee" at the knee. Rows marked "reaches" are the times
    to given errors. Rows with the quantity "part: NAME" have the seconds of that part as value.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("run", "iteration", "seconds", "quantity", "value", "mark"))
    for curves in groups:
        for found, on in zip(curves, front(curves), strict=True):
            bend, name = knee(found), found.quantity.key
            name = f"{name.removesuffix('_psnr').removeprefix('psnr_')}_rmse" if found.quantity.decibels else name
            for i, point in enumerate(zip(found.iterations, found.seconds, found.errors, strict=True)):
                marks = " ".join(mark for mark, marked in (("front", on[i]), ("knee", i == bend)) if marked)
                writer.writerow((found.run, int(point[0]), f"{point[1]:g}", name, f"{point[2]:.6g}", marks))
            for error in levels(curves):
                seconds = time_to(found, error)
                if seconds is not None:
                    writer.writerow((found.run, "", f"{seconds:.4g}", name, f"{error:.6g}", "reaches"))
    for run, history in histories.items():
        for line in history:
            for part, value in flatten(line.get("parts")):
                row = line.get("iteration", ""), f"{line['seconds']:g}", f"part: {part}", f"{value:g}", ""
                writer.writerow((run, *row))
    return text.getvalue()
