"""Define a case and write its outcome."""

from collections.abc import Callable
from typing import NamedTuple

NEVER = -1


class Found(NamedTuple):
    """Outcome of a case: whether all values are finite, the error, and when a disturbed training recovered.

    `recovered` counts iterations; it is NEVER if the training did not recover.
    """

    finite: bool
    error: float
    recovered: int | None = None


class Case(NamedTuple):
    """Stiff or extreme case. The error of `run` compared with `against` may be at most `most`.

    `because` says why so much is allowed; `guard` says what the program does about the case.
    """

    name: str
    run: Callable[[], Found]
    against: str
    most: float
    because: str
    guard: str
    unit: str = ""

    def holds(self, found: Found) -> bool:
        return found.finite and found.error <= self.most

    def row(self, found: Found) -> list[str]:
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
