"""Define a stability case, and format its outcome as a row of a table."""

from collections.abc import Callable
from typing import NamedTuple

NEVER = -1


class Outcome(NamedTuple):
    """Hold the outcome of a case: whether all values are finite, the error, and how long a disturbed training took to recover.

    `error` is in the unit of its case. `recovered` is a number of iterations, NEVER if the training did not recover, or None if nothing
    was disturbed.
    """

    finite: bool
    error: float
    recovered: int | None = None


class Case(NamedTuple):
    """Describe an ill-conditioned or extreme case. It passes if all values are finite and its error is at most `most`.

    `run` computes the outcome; `against` names what results are compared with. `because` says why an error of `most` is allowed; `guard`
    says what the program does in such a case.
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
    """Write a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"
