"""Compare runs by their curves of error over training time: Pareto fronts, knees, and the time to reach a given error.

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
    """Describe an error measure of history.jsonl by its key in the file and its title. Smaller errors are better.

    If `decibels` is True, the file has a PSNR in dB. The method `error` then converts it to an RMS error, for pixel values in 0..1.
    """

    key: str
    title: str
    decibels: bool = False

    def error(self, value: float) -> float:
        """Convert a value of history.jsonl to an error; a PSNR becomes an RMS error."""
        return 10 ** (-max(value, -6000.0) / 20) if self.decibels else value

    def text(self, error: float) -> str:
        """Format an error, in decibels if it comes from a PSNR."""
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
    """Hold one run's errors (n,) with their iterations and seconds, sorted by time."""

    run: str
    quantity: Quantity
    iterations: np.ndarray
    seconds: np.ndarray
    errors: np.ndarray


def curve(run: str, history: list[dict], quantity: Quantity) -> Curve:
    """Make the curve of one error measure from the lines of history.jsonl.

    Lines without this measure are skipped. So are errors and times that are not positive, as they have no logarithm.
    """
    found = [
        (_iteration(line), line["seconds"], quantity.error(line[quantity.key]))
        for line in history
        if is_number(line.get(quantity.key)) and line["seconds"] > 0
    ]
    rows = np.array(sorted((row for row in found if row[2] > 0), key=lambda row: row[1]), dtype=float).reshape(-1, 3)
    return Curve(run, quantity, *rows.T)


def _iteration(line: dict) -> float:
    return line["iteration"] if is_number(line.get("iteration")) else 0


def front(curves: list[Curve]) -> list[np.ndarray]:
    """Find the points of all curves that are on the common Pareto front. Returns a mask (n,) for each curve.

    A point is on the front if no other point beats it. A point beats another by a smaller error in at most the same time, or by at most the
    same error in less time.
    """
    seconds, errors = (np.concatenate([getattr(c, name) for c in curves]) for name in ("seconds", "errors"))
    order = np.lexsort((errors, seconds))
    best = np.minimum.accumulate(np.concatenate([[np.inf], errors[order]]))[:-1]
    on = np.zeros(len(errors), dtype=bool)
    on[order] = errors[order] < best
    return np.split(on, np.cumsum([len(c.errors) for c in curves])[:-1])


def knee(curve: Curve) -> int | None:
    """Find the index of a curve's knee, after which more training time improves little (Kneedle, Satopää et al. 2011, without smoothing).

    Each error is first replaced by the smallest error up to that time. Both axes are then logarithms, scaled to 0..1. A straight line joins
    the first and the last point. The knee is the point that lies furthest below this line. Returns None if the curve has fewer than five
    points, if it never improves, or if the knee is less than LEAST_KNEE below the line.
    """
    if len(curve.errors) < 5:
        return None
    x, y = np.log(curve.seconds), np.log(np.minimum.accumulate(curve.errors))
    if x[-1] <= x[0] or y[-1] >= y[0]:
        return None
    below = 1 - (x - x[0]) / (x[-1] - x[0]) - (y - y[-1]) / (y[0] - y[-1])
    at = int(below.argmax())
    return at if below[at] >= LEAST_KNEE else None


def time_to(curve: Curve, error: float) -> float | None:
    """Return the seconds after which the curve first reaches `error` or less. Return None if it never does.

    Between two points of the curve, the logarithms of time and error are interpolated linearly.
    """
    reached = np.flatnonzero(curve.errors <= error)
    if not len(reached):
        return None
    at = reached[0]
    if at == 0:
        return float(curve.seconds[0])
    x, y = np.log(curve.seconds[at - 1 : at + 1]), np.log(curve.errors[at - 1 : at + 1])
    return float(np.exp(x[0] + (np.log(error) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def levels(curves: list[Curve]) -> list[float]:
    """Choose about LEVELS error values for the table that says when each curve reaches them. Return the largest first.

    They are round numbers; if the errors come from a PSNR, they are round in decibels instead. The largest is smaller than the error at
    which the worst curve begins. The smallest is not below the smallest error of all curves.
    """
    quantity = curves[0].quantity
    worst, best = max(c.errors[0] for c in curves), min(c.errors.min() for c in curves)
    if best >= worst:
        return []
    ends = sorted(-20 * np.log10(e) if quantity.decibels else e for e in (worst, best))
    rounded = MaxNLocator(nbins=LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(*ends)
    inside = [quantity.error(float(x)) for x in rounded if ends[0] < x <= ends[1] or x == ends[0]]
    return sorted((e for e in inside if best <= e < worst), reverse=True)


def as_csv(histories: dict[str, list[dict]], groups: list[list[Curve]]) -> str:
    """Write the numbers behind the report's charts as CSV. The columns are run, iteration, seconds, quantity, value, mark.

    - A row for each point of a curve: `mark` is "front" if the point is on the Pareto front, "knee" if it is the curve's knee, "front knee"
      if it is both, otherwise empty.
    - A row with the mark "reaches": `seconds` is the time after which the curve first reaches the error `value`.
    - A row with the quantity "part: NAME": `value` is the seconds spent on the kind of work NAME, such as shading.
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
