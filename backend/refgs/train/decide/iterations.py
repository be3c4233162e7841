"""Decide whether a training can skip two things: the initial stage, and the last fifth of its remaining iterations."""

from refgs.formats.needs import Found
from refgs.train.decide.need import ASKED, Decision, Given, Moment, Need
from refgs.train.learn.coarse import cost
from refgs.train.state import State


class Initial(Need):
    """Decide whether the training needs the initial stage, which shades surfels before blending."""

    name, what = "initial", "a first stage of surfels shaded one by one"
    moments = ("start",)

    def due(self, state: State, moment: Moment) -> bool:
        # If surfels start on the hull, deferred shading alone finds better normals than after this stage: docs/notebook/ablations.md.
        left_out = state.from_hull or self.asked(state) == "off"
        return left_out and state.settings.initial.until > 0 and state.method.deferred

    def measure(self, state: State, given: Given) -> Decision:
        return Decision(False, ASKED if self.asked(state) == "off" else "surfels start on the hull of the masks")

    def apply(self, state: State, found: Found) -> None:
        state.change("initial.until", 0.0, "needs", found.why)
        state.initial = False


class Iterations(Need):
    """Decide whether the training needs the last fifth of its remaining iterations. A matte scene does not.

    If the user gave a time limit, nothing is decided here, because `Plan` then chooses the number of iterations that fills the time.
    """

    name, what = "iterations", "all iterations"
    moments, follows = ("start",), "specular"
    # Fraction of the remaining iterations after which matte scenes are as good as after all: docs/notebook/needs-and-minutes.md.
    ENOUGH = 0.8

    def due(self, state: State, moment: Moment) -> bool:
        matte = not state.needed("specular")
        asked = moment == "start" and self.asked(state) == "off"
        return (asked or matte) and state.plan.minutes is None

    def measure(self, state: State, given: Given) -> Decision:
        done, specular = given.done, state.needs.get("specular")
        total = done + round(self.ENOUGH * (state.total - done))
        left, why = 0.0, ASKED  # `left` is in seconds
        statistic = threshold = None
        if specular and specular.statistic is not None:
            statistic, threshold = specular.statistic, specular.threshold
            to_come = cost(state, done, state.total) / max(cost(state, 0, done), 1e-9)
            left = state.seconds * to_come - (specular.seconds or 0.0)
            why = "what mirrors nothing has less to learn"
        figures = {"total": total, "seconds": max(left, 0.0) * (1 - self.ENOUGH)}
        why = f"{why}: {total:,} in place of {state.total:,}"
        return Decision(False, why, figures, statistic, threshold)

    def apply(self, state: State, found: Found) -> None:
        state.total = min(state.total, int(found.total or state.total))
        state.effective = state.effective.noted("train.iterations", state.total, "needs", found.why)

    def undo(self, state: State, why: str) -> None:
        state.total = state.settings.train.iterations
        state.effective = state.effective.noted("train.iterations", state.total, "needs", why)
