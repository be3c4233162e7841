"""Define a stability case: a numerically hard input, and a check that the program survives it. Format its outcome as a row of a table."""

from collections.abc import Callable
from typing import NamedTuple

NEVER = -1


class Outcome(NamedTuple):
    """Hold the outcome of a case. `finite` is True if no value is NaN or infinite.

    `error` is measured in the unit that `Case.unit` names; it has no unit if that is empty.
    `recovered` is for cases that disturb a training: the number of iterations that it took to recover, or NEVER. It is None in other cases.
    """

    finite: bool
    error: float
    recovered: int | None = None


class Case(NamedTuple):
    """Describe an extreme or ill-conditioned case. It passes if all values are finite and its error is at most `most`.

    - `run` runs the case and returns the outcome;
    - `against` names what the results are compared with, such as "float64, same input";
    - `because` gives the reason why an error of `most` is allowed;
    - `guard` tells how the program protects itself in this case.
    """

    name: str
    run: Callable[[], Outcome]
    against: str
    most: float
    because: str
    guard: str
    unit: str = ""

    def holds(self, found: Outcome) -> bool:
        return found.finite and found.error <= self.most

    def row(self, found: Outcome) -> list[str]:
        error, most = (
            f"{v:.2f} {self.unit}" if self.unit else f"{v:.0e}" if v else "0" for v in (found.error, self.most)
        )
        back = {None: "", NEVER: "not to the end"}.get(found.recovered, f"{found.recovered}")
        fails = "" if self.holds(found) else "**fails** "
        return [
            fails + self.name,
            "yes" if found.finite else "**no**",
            error,
            f"{most}: {self.because}",
            self.against,
            back,
            self.guard or "nothing is needed",
        ]


HEADINGS = ["case", "finite", "error", "at most", "compared with", "back after, iterations", "what is done about it"]


def line(cells: list[str]) -> str:
    """Return a row of a Markdown table with these cells."""
    return f"| {' | '.join(cells)} |"
