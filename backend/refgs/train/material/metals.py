"""Set surfels' metallic values by what photos tell (see `reckoning`).

Paint explains photos of a rough or embossed metal about as well as metal does, and black paint those of a mirror in the dark. Training
starts near paint, so it would stay there. So whether a surfel is metal is reckoned from the photos early in the training, and again at
some new meshes. Metallic values do not learn in between.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from refgs.model.surfels import raw_metallic
from refgs.train.material import base_colors, gloss, highlights, questions
from refgs.train.material.observe import Kinds
from refgs.train.material.reckoning import like_metals, reckon
from refgs.train.part import Fact, Part
from refgs.train.state import State
from refgs.train.timeline import Step, metals_decidable, metals_judged_again

HELD = Kinds(metal=0.98, paint=0.002)  # metallic that does not learn, in the order of `hints.KINDS`
SHARP = Kinds(metal=0.1, paint=gloss.LEAST)  # roughness from which surfels learn, at most, once metals are found
TOLD = 0.005  # a change of a larger fraction of the surface is announced


class Metals(Part):
    """Remember whether metals have already been `found`.

    Of each surfel, remember whether hints hold its kind (`held`), whether photos tell it (`told`), how rough it is at most
    (`roughest`, see `gloss`), and the base colour that it keeps to (`shown_color`): of metal, what photos tell of it (see
    `base_colors.told`), and of paint, what it had learned when its shades were first kept. Checkpoints also keep `state.told_light`. It is
    None unless photos tell base colours of metals that mirror enough of it; without masks, they never do. `hue` (3,) is the light's
    (`base_colors.told_hue`), and `mean` is that of paint (`base_colors.wanted`).
    """

    name, saved = "metals", ("found", "hue", "mean")
    found = False
    hue: torch.Tensor
    mean: torch.Tensor | None = None

    def start(self, state: State) -> None:
        self.found, state.told_light = False, None
        self.hue = torch.zeros(3, device=state.device)
        if "metallic" in state.learned:
            state.learned.learn("roughest", torch.ones(state.learned.count, device=state.device))
            state.learned.learn("shown_color", torch.zeros(state.learned.count, 4, device=state.device))
            for name in ("held", "told"):
                none = torch.zeros(state.learned.count, dtype=torch.bool, device=state.device)
                state.learned.learn(name, none)

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        super().restore(state, {"hue": self.hue, **facts})
        state.told_light = facts.get("told_light")

    def facts(self, state: State) -> dict[str, Fact]:
        told = state.told_light
        return super().facts(state) | ({} if told is None else {"told_light": told})


def find_metals(state: State, step: Step) -> None:
    """Find metals for the first time, once surfels lie near the surface.

    Trainings that propagate normals do not call this function. Propagation finds their metals, as in the Ref-Gaussian paper.
    """
    if not state.part(Metals).found:
        state.part(Metals).found = True
        _judge(state, first=True)


def judge(state: State, step: Step) -> None:
    """Judge again which surfels are metal."""
    if state.part(Metals).found:
        _judge(state)


@torch.no_grad()
def _judge(state: State, first: bool = False) -> None:
    """Set metallic to the likelier kind, and hold it there until the next look. Hints hold theirs. It learns where no photo tells.

    It does not learn where photos leave doubt, either: training turns metal into paint, by changing the light. But the first time, shapes
    are wrong, and paint that is taken for metal spoils them for good. So if there will be another look, metallic learns until then where
    there is doubt.

    A surfel that was taken for paint, but is metal, takes the base colour and roughness of the metals around it. An example is the lower
    half of a ball on a table: it mirrors only the table, so it has learned the table's colour as its own. The first time, all metals take
    the base colour that photos tell.
    """
    found = reckon(state)
    metallic, albedo, roughness = (state.learned[name] for name in ("metallic", "albedo", "roughness"))
    free, likely = ~state.learned["held"], found.metal.to(metallic.device)
    was = state.surfels().metallic > 0.5
    sure = 1 - questions.DOUBTFUL / 2 if first and metals_judged_again(state) else 0.5
    metal, paint = free & (likely > sure), free & (likely < 1 - sure)
    raised, lowered = metal & ~was, paint & was
    metallic[metal], metallic[paint] = raw_metallic(HELD.metal), raw_metallic(HELD.paint)
    state.learned["told"].copy_(metal | paint)
    shown = state.learned["shown_color"]
    told, painted = (kind.cpu() for kind in _told_kinds(state))  # hints' kinds, too
    shown.copy_(base_colors.told(found, told) * told[:, None])  # paint keeps to its own
    state.part(Metals).hue = base_colors.told_hue(found, painted).to(state.device)
    light = base_colors.told_light(found, told) if state.from_hull and bool(shown.any()) else None
    state.told_light = None if light is None else light.to(state.device)
    if raised.any():
        material = torch.logit(base_colors.plausible(like_metals(found))).to(metallic.device)
        albedo[raised], roughness[raised] = material[raised, :3], material[raised, 3]
    if first:
        # The first light is blurred. A surfel that became rough under it would stay so: it spreads a lamp's highlight to where photos show
        # none, so that it becomes rougher still. One that is too sharp learns.
        fresh = likely > 0.5
        roughness.copy_(roughness.minimum(torch.where(fresh, SHARP.metal, SHARP.paint).logit()))
        state.learned.forget("roughness", fresh)
        fresh = told.to(shown.device) & (shown[:, 3] > 0)
        albedo[fresh] = torch.logit(shown[fresh, :3])
        state.learned.forget("albedo", fresh)
    for name in ("albedo", "roughness"):
        state.learned.forget(name, raised | lowered)
    state.learned.forget("metallic", metal | paint)
    whole = max(float(found.pixels.sum()), 1e-6)
    kinds = told, raised, lowered
    metals, more, less = (float(found.pixels[which.cpu()].sum()) / whole for which in kinds)
    words = (
        f"{metals:.0%} of the surface is metal: {more:.1%} had been taken for paint, and {less:.1%} is paint after all"
    )
    state.announce("metals", words, detail=max(more, less) < TOLD)


class Doubt(NamedTuple):
    """Hold what photos leave open about metal and paint.

    - `values` (N,): each surfel's doubt (see `doubt`)
    - `facts`: for metrics.json. `part` is the fraction of the surface whose doubt is at least `questions.DOUBTFUL`. `what` says so to the
      user, if `part` is more than TOLD.
    - `questions`: the largest pieces in doubt
    """

    values: torch.Tensor
    facts: dict[str, float | str]
    questions: list[questions.Question]


@torch.no_grad()
def doubt(state: State) -> Doubt | None:
    """Measure each surfel's doubt: 1 − |2 p − 1|, where p is the probability of metal (see `reckoning`). What was learned does not count.

    Doubt is 0 where photos clearly show metal or paint, and 1 where no photo tells. Surfels that hints hold have doubt 0.

    If a part of the surface is in doubt, it is announced to the user. Returns None if photos do not decide what is metal, for example
    without specular shading, or if a photo has no mask.
    """
    if not state.from_hull or not metals_decidable(state, state.iteration):
        return None
    found = reckon(state)
    values = 1 - (2 * found.metal - 1).abs()
    values[state.learned["held"].cpu() & found.shown] = 0
    part = float(found.pixels[values >= questions.DOUBTFUL].sum()) / max(float(found.pixels.sum()), 1e-6)
    facts: dict[str, float | str] = {"part": part}
    if part > TOLD:
        facts["what"] = f"photos do not tell metal from paint on {part:.0%} of the surface"
        state.announce("doubt", facts["what"])
    return Doubt(values, facts, questions.ask(state, found, values))


@torch.no_grad()
def hold_as(state: State, kinds: torch.Tensor) -> None:
    """Set and hold metallic values by `kinds` (N,): 0 metal, 1 paint, −1 not held."""
    for number in range(len(HELD)):
        state.learned["metallic"][kinds == number] = raw_metallic(HELD[number])
    state.learned["held"].copy_(kinds >= 0)
    state.learned.forget("metallic", kinds >= 0)
    state.part(Metals).found = True


def draw_metals(state: State, step: Step) -> None:
    """Draw base colours of metals to what photos tell."""
    if _metals_drawn(state):
        base_colors.draw(state, _told_kinds(state)[0])


def level_base_colors(state: State, step: Step) -> None:
    """Keep mean base colours, and with them lamps, at what photos and experience tell, see `base_colors`."""
    part = state.part(Metals)
    if _metals_drawn(state):
        metals, paint = _told_kinds(state)
        base_colors.level(state, metals)
        if _light_told(state):
            base_colors.balance(state, paint, part.hue, part.mean)


def compare_highlights(state: State, step: Step) -> None:
    """Learn from highlights, and from experience, how bright paint is in the mean."""
    if _light_told(state):
        part, paint = state.part(Metals), _told_kinds(state)[1]
        brighter = base_colors.with_brighter_lamps(state, paint, highlights.BRIGHTER)
        part.mean = base_colors.wanted(state, paint, highlights.compare(state, brighter, step.done), part.mean)


@torch.no_grad()
def find_glossy_paint(state: State, step: Step) -> None:
    """Tell how rough paint is at most, see `gloss`."""
    if _gloss_learns(state):
        state.learned["roughest"].copy_(gloss.roughest(state, _told_kinds(state)[1], step.done))


@torch.no_grad()
def keep_paint_glossy(state: State, step: Step) -> None:
    """Keep paint no rougher than photos tell."""
    if _gloss_learns(state):
        raw = state.learned["roughness"]
        raw.copy_(raw.minimum(base_colors.plausible(state.learned["roughest"]).logit()))


def average_paint(state: State, step: Step) -> None:
    """Average base colours of paint over neighbours, so that the light learns shades, and not the paint."""
    if _light_told(state):
        base_colors.average(state, _told_kinds(state)[1])


def keep_shades(state: State, step: Step) -> None:
    """Keep shades of base colours, so that only what is finer learns."""
    if _metals_drawn(state):
        metals, paint = _told_kinds(state)
        base_colors.keep_shades(state, metals, paint & _light_told(state))


def _metals_drawn(state: State) -> bool:
    """Tell whether base colours of metals keep to what photos show of the object, if they do. That needs no light."""
    return state.from_hull and {"albedo", "metallic"} <= state.learned.keys()


def _light_told(state: State) -> bool:
    """Tell whether metals tell enough of the light, so that paint has to follow it."""
    return state.told_light is not None and _metals_drawn(state)


def _gloss_learns(state: State) -> bool:
    return {"roughness", "roughest"} <= state.learned.keys()


def _told_kinds(state: State) -> tuple[torch.Tensor, torch.Tensor]:
    """Tell which surfels (N,) are metal, and which are paint, by hints or because photos tell."""
    known, metal = state.learned["held"] | state.learned["told"], state.learned["metallic"] > raw_metallic(0.5)
    return known & metal, known & ~metal


def hold(state: State) -> None:
    """Zero the gradient of metallic values where hints hold them, or photos tell them."""
    metallic = state.learned.get("metallic")
    if metallic is not None and metallic.grad is not None:
        metallic.grad.masked_fill_(state.learned["held"] | state.learned["told"], 0)
