"""Tell when each action of a training is done. Each action has one `Row`.

`Trainer.step` does what is due in BEFORE, renders a photo and takes a step of Adam, and then does what is due in AFTER.
`scripts/timeline_page.py` prints all rows into docs/timeline.md. No other module compares the training's progress with a threshold.

A training's progress is the fraction of its iterations that are done, 0..1.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from refgs.render.rendering import Rendering
from refgs.settings import DensifySettings, RateSettings
from refgs.train.photo import Photo
from refgs.train.plan import PART, SHAPES, Stage
from refgs.train.start import GEOMETRY
from refgs.train.state import State, why_not_traced

RESET = 0.01  # opacity to which a reset lowers all surfels
# Surfels explain a picture from this opacity on: while they are fainter, nothing is decided, and no mesh is made.
SEEN = 0.2
# Parts of the training after which poses start to learn, are judged, and are frozen.
POSES_FROM, POSES_KNOWN, POSES_UNTIL = 0.05, 0.3, 2 / 3
WHOLE_EVERY = 8  # one in this many iterations sees its whole photo, so that nothing stays beyond the margin of a crop
REFLECTING = ("albedo", "metallic", "roughness", "indirect_dc", "indirect_rest", "environment", "exposure")
PHOTO_STAGES = (0.35, 4), (0.7, 2)  # part of the training until which photos are reduced, and by what factor
MESH_COST, DIVIDE_COST = 45, 2  # time for making a mesh, and for dividing surfels, in iterations
FIRST_LINE, A_DECADE = 10, 10  # first iteration with a line in the history, and lines for each tenfold of iterations


class Step:
    """Hold the facts of the iteration that is being done.

    `progress` is the training's progress (0..1) when the iteration begins. `done` counts finished iterations, and includes this one from
    Adam's step on. `view` is the index of the training view. `hidden` is None unless this iteration has made a mesh. Then it is the
    fraction of the object's pixels that mirror the object. `photo` and `rendering` are set from Adam's step on.
    """

    photo: Photo
    rendering: Rendering

    def __init__(self, state: State, view: int = 0) -> None:
        self.progress = min(state.iteration / state.total, 1.0)
        self.done, self.view = state.iteration, view
        self.hidden: float | None = None


Test = Callable[[State, Step], bool]


class When(NamedTuple):
    """Hold a condition, for example that a time has passed, with `words` for docs/timeline.md."""

    words: str
    holds: Test

    def __and__(self, other: "When") -> "When":
        words = f"{self.words}, {other.words}"
        return When(words, lambda state, step: self.holds(state, step) and other.holds(state, step))

    def __or__(self, other: "When") -> "When":
        words = f"{self.words} or {other.words}"
        return When(words, lambda state, step: self.holds(state, step) or other.holds(state, step))


class Every(NamedTuple):
    """Hold a period in iterations, 0 for never, and its `words` for docs/timeline.md."""

    words: str
    length: Callable[[State], int]


def share(of: float) -> Every:
    """Return a period that is the fraction `of` of the training."""
    return Every(f"{100 * of:g}%", lambda state: max(1, int(of * state.total)))


ONCE = Every("once", lambda state: 1)
"""Each iteration. The part itself remembers whether it was done."""


class Row(NamedTuple):
    """Tell when one action is done: from `start` on and before `until`, in iterations that are multiples of `every`, if `only_if` holds.

    `clock` is the part of the training's clock (`refgs.clock`) to which the action's time is added. If it is None, `walk` does not time it.
    `cost` is the time of an action that may be left out, in iterations: of each time if there is a period, else of all times together.
    `most` is the fraction of a training's iterations that it may take at most, if a time is given.
    """

    what: str
    start: When | None = None
    until: When | None = None
    every: Every | None = None
    only_if: When | None = None
    clock: str | None = None
    cost: int = 0
    most: float = PART

    def pays(self, state: State) -> bool:
        """Tell whether the action is worth its time, if a time is given (see `Plan.pays`)."""
        length = self.every.length(state) if self.every and self.every is not ONCE else state.total
        return self.cost == 0 or state.plan.pays(self.what, self.cost / min(length, state.total), self.most)

    def due(self, state: State, step: Step) -> bool:
        """Tell whether the row is due in this iteration."""
        if self.every and not ((length := self.every.length(state)) and step.done % length == 0):
            return False
        if self.start and not self.start.holds(state, step):
            return False
        if self.until and self.until.holds(state, step):
            return False
        return not self.only_if or self.only_if.holds(state, step)


def part(of: float) -> When:
    """Return the time at which the training has reached the progress `of`, 0..1."""
    return When(f"{of:.0%}", lambda state, step: step.progress >= of)


def part_after_initial(of: float) -> When:
    """Return when the fraction `of` of the training has passed after the initial stage."""
    return When(f"`initial.until` + {of:.0%}", lambda state, step: step.progress - state.settings.initial.until >= of)


def iteration(number: int) -> When:
    """Return the time when `number` iterations are done."""
    return When(f"iteration {number}", lambda state, step: step.done >= number)


def setting(key: str) -> When:
    """Return the time that the setting `key`, "section.name", gives as a fraction of the training."""
    section, name = key.split(".")
    return When(f"`{key}`", lambda state, step: step.progress >= getattr(getattr(state.settings, section), name))


def period(key: str) -> Every:
    """Return the period that the setting `key`, "section.name", gives in iterations."""
    section, name = key.split(".")
    return Every(f"`{key}`", lambda state: getattr(getattr(state.settings, section), name))


def iterations(count: int) -> Every:
    """Return a period of `count` iterations."""
    return Every(f"{count}", lambda state: count)


def decidable(state: State, done: int) -> bool:
    """Tell whether surfels, materials and light can be judged after `done` iterations.

    For this, the method must shade pixels by materials, the initial stage (see `start_deferred`) must be over, and surfels must no longer
    be faint after an opacity reset.
    """
    by_pixels = state.method.deferred and state.settings.render.diffuse == "irradiance"
    return by_pixels and not state.initial and not faint_now(state, done)


def metals_decidable(state: State, done: int) -> bool:
    """Tell whether the photos can show what is metal."""
    settings = state.settings
    return settings.render.reflection == "microfacet" and not settings.propagation.every and decidable(state, done)


def metals_judged_again(state: State) -> bool:
    """Tell whether metals will be judged again: not without masks, not without another mesh, and not where that takes too much time."""
    period = JUDGE.length(state) if why_not_traced(state) else state.settings.indirect.every
    following = (state.iteration // period + 1) * period
    return state.from_hull and following < state.residual_start * state.total and JUDGE_METALS.pays(state)


def since_propagation(state: State, done: int) -> int | None:
    """Count the iterations since normals were propagated; None before this begins or after it ends."""
    settings = state.settings.propagation
    if not settings.every or done < settings.every or not state.method.lit:
        return None
    last = done // settings.every * settings.every
    return done - last if last / state.total < settings.stop else None


def faint_now(state: State, done: int, opacity: float = SEEN) -> bool:
    """Tell whether the last opacity reset was so recent that useful surfels may still be too transparent after `done` iterations.

    An opacity reset makes all surfels nearly transparent. Useful surfels become opaque again as they learn, and this function estimates
    whether they have had enough iterations to reach `opacity`.
    """
    return faint(state.settings.densify, state.settings.rates, done, state.total, opacity)


def faint(settings: DensifySettings, rates: RateSettings, iteration: int, total: int, opacity: float) -> bool:
    """Tell whether the last opacity reset before `iteration` was so recent that useful surfels may still be too transparent.

    The time until they reach `opacity` is estimated: in each iteration, Adam moves an opacity's logit by about the learning rate, which
    decays. The function returns true until four times this estimate has passed. `total` is the number of iterations of the training.
    """
    every = settings.reset_every
    last = min(iteration, math.ceil(settings.stop * total)) - 1  # a reset at the end of this iteration does not count
    if not every or last < every:
        return False
    since, decay = last // every * every, rates.decay
    iterations = iteration - since
    if decay != 1:
        iterations = total * (decay ** (since / total) - decay ** (iteration / total)) / -math.log(decay)
    opacity = max(opacity, RESET)
    return iterations * rates.opacity < 4 * math.log(opacity / (1 - opacity) * (1 - RESET) / RESET)


def stage_at(progress: float, stages: tuple[Stage, ...]) -> Stage:
    """Return the stage of a training at a progress of 0..1."""
    return next(stage for stage in stages if progress < stage.until or stage.until == 1)


def even_by_logarithm(iteration: int) -> bool:
    """Tell whether the history should have a line for this iteration.

    Lines are evenly spaced on a logarithmic axis: A_DECADE lines from iteration 10 to 100, as many from 100 to 1000, and so on.
    """
    place, before = (math.floor(A_DECADE * math.log10(max(i, 1))) for i in (iteration, iteration - 1))
    return iteration >= FIRST_LINE and place > before


def _late(state: State, part: float) -> float:
    """Return the progress (0..1) at which the fraction `part` of residual learning is over."""
    return state.residual_start + part * (1 - state.residual_start)


def _resets(state: State, step: Step) -> bool:
    """Tell whether opacities may be reset in this iteration."""
    return step.done / state.total < state.settings.densify.stop and since_propagation(state, step.done) != 0


def _plans(state: State, step: Step) -> bool:
    """Tell whether to plan now: at multiples of 10 and at the end, but not within 5 iterations after `Plan.begin`."""
    return step.done - state.plan.first >= 5 and (step.done % 10 == 0 or step.done >= state.total)


def _judged(state: State, step: Step) -> bool:
    """Tell whether metals are judged in this iteration. One judgement takes as long as some dozen iterations."""
    length, every = JUDGE.length(state), state.settings.indirect.every
    if why_not_traced(state):
        return step.done % length == 0
    return step.hidden is not None and step.done // length > (step.done - every) // length


RESIDUAL = When("`residual.start`", lambda state, step: step.progress >= state.residual_start)
LIGHT_FIRST = When("iteration `train.light_first`", lambda state, step: step.done >= state.settings.train.light_first)
NOT_ENDED = When("not the last iteration", lambda state, step: step.done < state.total)
INITIAL = When("the initial stage is not over", lambda state, step: state.initial)
NOT_INITIAL = When("the initial stage is over", lambda state, step: not state.initial)
OPAQUE = When("no opacity reset was just before", lambda state, step: not faint_now(state, step.done))
PRUNABLE = When(
    "an opacity reset is long enough past for `densify.prune_opacity`",
    lambda state, step: not faint_now(state, step.done, state.settings.densify.prune_opacity),
)
DECIDABLE = When("pixels are shaded, no opacity reset was just before", lambda state, step: decidable(state, step.done))
METALS = When(
    "pixels are mirrors, no opacity reset was just before, `propagation.every` = 0",
    lambda state, step: metals_decidable(state, step.done),
)
LIT = When("there is a light", lambda state, step: state.method.lit)
FROM_HULL = When("all photos have masks", lambda state, step: state.from_hull)
DEFERRED = When("pixels are shaded", lambda state, step: state.method.deferred)
NEW_MESH = When("a mesh was made", lambda state, step: step.hidden is not None)
JUDGE = share(1 / 4)
JUDGED = When(f"the first mesh in each {JUDGE.words} was made; where none is, every {JUDGE.words}", _judged)
RESTS = When(
    "for `propagation.rest` iterations after normals were propagated",
    lambda state, step: (since := since_propagation(state, step.done)) is not None
    and since < state.settings.propagation.rest,
)

LARGER = Every(", ".join(f"after {until:.0%}" for until, _ in PHOTO_STAGES), lambda state: 1)
DECIDE = partial(Row, every=ONCE, only_if=DECIDABLE, clock="deciding")
HALFWAY = When("50%", lambda state, step: 2 * step.done >= state.total)
LATE = When("70% from `residual.start` to the end", lambda state, step: step.progress >= _late(state, 0.7))
PROPAGATES = When("before `propagation.stop`", lambda state, step: since_propagation(state, step.done) == 0)
RESETS = When("before `densify.stop`, normals are not propagated", _resets)
TENFOLD = When("10 times while iterations grow tenfold", lambda state, step: even_by_logarithm(step.done))

BEFORE = (
    Row("take larger photos", every=LARGER),
    Row("start the deferred stage", setting("initial.until"), every=ONCE, only_if=INITIAL),
    Row("start the residual", RESIDUAL, every=ONCE),
    Row("set the rates"),
    Row("refine the light", part(0.2), every=ONCE, only_if=LIT),
)
"""Rows that are done before the photo is rendered."""

WHOLE = Row("train on the whole photo, not on its crop", every=iterations(WHOLE_EVERY))
FROZEN = (
    (GEOMETRY, Row("hold the surfels' shapes", until=LIGHT_FIRST, only_if=FROM_HULL & DEFERRED)),
    (("opacity",), Row("hold opacities", only_if=RESTS)),
    (REFLECTING, Row("hold materials, light and exposures", RESIDUAL)),
)
"""Tensors that do not learn, and the row that says when."""

JUDGE_METALS = Row(
    "judge metals", until=RESIDUAL, only_if=JUDGED & FROM_HULL & METALS, clock="deciding", cost=300, most=SHAPES
)
AFTER = (
    Row("refine the view's pose", part(POSES_FROM), part(POSES_UNTIL)),
    Row("remove the poses' common motion", part(POSES_FROM), part(POSES_UNTIL), Every("views", lambda s: len(s.views))),
    Row("diffuse the light", only_if=LIT),
    Row("balance the exposures"),
    # Meshes and decisions come before an opacity reset, which makes all surfels faint. No mesh is made after the residual has started to
    # learn, because materials would no longer adapt to it.
    Row(
        "make a mesh",
        setting("indirect.start"),
        RESIDUAL,
        period("indirect.every"),
        NOT_INITIAL & NOT_ENDED & OPAQUE,
        cost=MESH_COST,
    ),
    Row("decide on inter-reflection", only_if=NEW_MESH, clock="deciding"),
    Row("trace what surfels receive", only_if=NEW_MESH, clock="visibility"),
    DECIDE("time the crops", iteration(100), cost=6),
    DECIDE("look at a matte scene again", HALFWAY, cost=60),
    DECIDE("decide on specular shading", part_after_initial(0.05) & iteration(100), cost=60),
    DECIDE("decide on the light's texels", part_after_initial(0.19), cost=40),
    DECIDE("decide on degrees of harmonics", LATE, cost=40),
    # The longer the light learns from things that are all taken for paint, the more it explains metals as paint, too. But without masks,
    # surfels take long to lie on the surface.
    DECIDE(
        "find metals",
        part_after_initial(0.05) & iteration(150) & (FROM_HULL | part_after_initial(0.1)),
        RESIDUAL,
        only_if=METALS,
        cost=180,
        most=SHAPES,
    ),
    JUDGE_METALS,
    Row("even coloured metal out", None, part(0.6), iterations(50)),
    Row("find glossy paint", part(0.4), RESIDUAL, share(0.085), clock="deciding", cost=13),
    Row("keep paint glossy", part(0.4), RESIDUAL, iterations(10)),
    Row("compare highlights", part(0.3), RESIDUAL, share(1 / 25), clock="deciding", cost=4, most=SHAPES),
    Row("level base colours", until=RESIDUAL, every=iterations(10)),
    Row("draw metals' base colours", None, part(0.6), iterations(10)),
    Row("average paint's base colours", None, part(0.6), share(1 / 50)),
    Row("keep shades of base colours", part(0.6), RESIDUAL, share(1 / 50)),
    Row("prune and divide surfels", setting("densify.start"), None, period("densify.every"), PRUNABLE),
    Row("propagate normals", every=period("propagation.every"), only_if=PROPAGATES, clock="densification"),
    Row("reset opacities", every=period("densify.reset_every"), only_if=RESETS),
    Row("leave out exposures that agree", part(0.3), None, share(1 / 20), NOT_INITIAL & OPAQUE),
    Row("judge the poses", part(POSES_KNOWN), every=ONCE),
)
"""Rows that are done after Adam's step."""

DIVIDE = Row("divide surfels, not only prune", until=setting("densify.stop"))
PLAN = Row(
    "plan the iterations that fit into the time",
    only_if=When("every 10, and at the end: there may be time for more", _plans),
)
REPORT = Row("report the progress, look for broken numbers", every=iterations(10))
RECORD = Row("measure errors into the history", only_if=NOT_ENDED & TENFOLD)
CHECKPOINT = Row("write a checkpoint", every=period("train.checkpoint_every"), only_if=NOT_ENDED)
