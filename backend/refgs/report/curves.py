"""Error against run time: what a history says of it, and what follows.

Errors are compared by their logarithms, and so are times: a tenth less counts the same wherever it is.
"""

import csv
import io
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from refgs.report.figures import flatten, is_number

LEVELS = 6  # errors that a table says the time to, about
LEAST_KNEE = 0.1  # of the chord's height: what is less bent has no knee


class Quantity(NamedTuple):
    """A key of history.jsonl, what its error is called, and that error, less being better. Peaks being 1, a PSNR in dB is −20 log₁₀ of
    the root of the mean squared error."""

    key: str
    title: str
    decibels: bool = False

    def error(self, value: float) -> float:
        return 10 ** (-value / 20) if self.decibels else value

    def text(self, error: float) -> str:
        """An error in words, in decibels where those are what it is known by."""
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
    """Errors of a run against its seconds of training, ascending: (n,) each."""

    run: str
    quantity: Quantity
    iterations: np.ndarray
    seconds: np.ndarray
    errors: np.ndarray


def curve(run: str, history: list[dict], quantity: Quantity) -> Curve:
    """What the lines of a history say of a quantity; lines without it, or with none that has a logarithm, are passed over."""
    found = [
        (line.get("iteration", 0), line["seconds"], quantity.error(line[quantity.key]))
        for line in history
        if is_number(line.get(quantity.key)) and line["seconds"] > 0
    ]
    rows = np.array(sorted((row for row in found if row[2] > 0), key=lambda row: row[1]), dtype=float).reshape(-1, 3)
    return Curve(run, quantity, *rows.T)


def front(curves: list[Curve]) -> list[np.ndarray]:
    """Which points of each curve (n,) are on the Pareto front of them all: no other has a smaller error in as little time, nor as small an
    error in less."""
    seconds, errors = (np.concatenate([getattr(c, name) for c in curves]) for name in ("seconds", "errors"))
    order = np.lexsort((errors, seconds))
    best = np.minimum.accumulate(np.concatenate([[np.inf], errors[order]]))[:-1]
    on = np.zeros(len(errors), dtype=bool)
    on[order] = errors[order] < best
    return np.split(on, np.cumsum([len(c.errors) for c in curves])[:-1])


def knee(found: Curve) -> int | None:
    """The point from which on time brings the least more: that furthest below the chord from the first point to the best one, both axes
    being logarithms brought to 0..1 (Kneedle, Satopää et al. 2011, of the best error so far, not smoothed). None where the curve has
    fewer than five points, or bends by less than LEAST_KNEE: a power law is a straight line, and has no knee."""
    if len(found.errors) < 5:
        return None
    x, y = np.log(found.seconds), np.log(np.minimum.accumulate(found.errors))
    if x[-1] <= x[0] or y[-1] >= y[0]:
        return None
    below = 1 - (x - x[0]) / (x[-1] - x[0]) - (y - y[-1]) / (y[0] - y[-1])
    at = int(below.argmax())
    return at if below[at] >= LEAST_KNEE else None


def time_to(found: Curve, error: float) -> float | None:
    """Seconds to an error, by logarithms between the points about it; None where it was not reached."""
    reached = np.flatnonzero(found.errors <= error)
    if not len(reached):
        return None
    at = reached[0]
    if at == 0:
        return float(found.seconds[0])
    x, y = np.log(found.seconds[at - 1 : at + 1]), np.log(found.errors[at - 1 : at + 1])
    return float(np.exp(x[0] + (np.log(error) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def levels(curves: list[Curve]) -> list[float]:
    """A few round errors, in decibels where those are what it is known by, that the curves pass, the largest first."""
    quantity = curves[0].quantity
    worst, best = max(c.errors[0] for c in curves), min(c.errors.min() for c in curves)
    if best >= worst:
        return []
    ends = sorted(-20 * np.log10(e) if quantity.decibels else e for e in (worst, best))
    round_ones = MaxNLocator(nbins=LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(*ends)
    inside = [quantity.error(float(x)) for x in round_ones if ends[0] < x <= ends[1] or x == ends[0]]
    return sorted((e for e in inside if best <= e < worst), reverse=True)


def as_csv(histories: dict[str, list[dict]], groups: list[list[Curve]]) -> str:
    """All that the charts and tables show: the columns run, iteration, seconds, quantity, value, mark.

    A line for each point of a curve, which is marked "front" and "knee", and for the seconds of each part; and for the times to given
    errors, "reaches".
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("run", "iteration", "seconds", "quantity", "value", "mark"))
    for curves in groups:
        for found, on in zip(curves, front(curves), strict=True):
            bend, name = knee(found), found.quantity.key
            name = f"{name.removesuffix('_psnr').removeprefix('psnr_')}_rmse" if found.quantity.decibels else name
            for i, point in enumerate(zip(found.iterations, found.seconds, found.errors, strict=True)):
                marks = " ".join(mark for mark, is_so in (("front", on[i]), ("knee", i == bend)) if is_so)
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
