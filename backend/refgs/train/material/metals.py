"""Set a first metallic value for each surfel by how its colour changes with the viewing direction.

Paint explains photos of a rough or embossed metal about as well as metal does. Training starts near paint, so it would stay there. A metal
tints what it mirrors. So the tint of a surfel's changes tells metal from paint before normals and light are known.

If nearly all of the surface changes as coloured metals do, metallic values are held: they no longer learn. Otherwise, training would turn
parts of the surface back into paint, which explains the photos about as well.
"""

from typing import NamedTuple

import torch

from refgs.model.surfels import Surfels, raw_metallic
from refgs.train.material import mirrored, questions, same_material, shown_light
from refgs.train.material.changes import falls_as_metal, shines_as_metal
from refgs.train.material.changing_light import explained
from refgs.train.material.observe import Kinds, Seen, observe_changes
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step, metals_decidable

GIVEN = Kinds(metal=0.9, paint=0.02)  # metallic that is set first; training can still change it
CERTAIN = 0.85  # part of the surface that shines as coloured metals do: all is metal; gold 0.95, matte clay 0.71
# Dark parts may be metal if a larger fraction of the coloured surface shines; a bronze head has 0.69, a car 0.14.
MOSTLY = 0.6
TELLING = 0.3  # fraction of the surface that must be coloured to tell about the rest; a bronze head has 0.48
TOLD = 0.005  # a change of a larger fraction of the surface is announced
HELD = Kinds(metal=0.98, paint=0.002)  # metallic that does not learn, in the order of `hints.KINDS`


class Metals(Part):
    """Remember in `found` whether metals have already been found."""

    name, saved = "metals", ("found",)
    found = False

    def start(self, state: State) -> None:
        self.found = False
        if "metallic" in state.learned:
            held = torch.zeros(state.learned.count, dtype=torch.bool, device=state.device)
            state.learned.learn("held", held)


def find_metals(state: State, step: Step) -> None:
    """Raise the metallic value of surfels whose colour changes with the view as only a metal's does. Done once, early in the training.

    `shines_as_metal` finds coloured metals, and `falls_as_metal` finds metals of any colour. Two findings rule metal out, and lower the
    metallic values that were learned so far:

    - The changes fit a light that differs between photos far better than they fit mirroring (see `changing_light.explained`). Then
      nothing is metal.
    - The changes of coloured surfels fit neither a changing light nor mirroring. Then nothing coloured is metal. Fur is an example: from
      some views, it hides what is below it, which has the same colour.

    If nearly all of the surface changes as coloured metals do, all surfels are metal from then on (see `hold`). Faint changes also count
    for this if they fit mirroring. Otherwise, surfels that are not found to be metal keep their metallic value.

    If most of the coloured surface changes as metals do, dark parts may be metal, too, such as patina. So dark metals are no longer
    penalised (`loss.dark` is 0 from then on).

    Trainings that propagate normals do not call this function. Propagation finds their metals, as in the Ref-Gaussian paper.
    """
    if state.part(Metals).found:
        return
    observations, metallic = observe_changes(state), state.learned["metallic"]
    positions, weight = state.learned["position"].detach(), observations.pixels.sum(dim=1) * state.wanted()
    coloured, faint, tells = shines_as_metal(observations, positions)
    metal = coloured | falls_as_metal(observations, positions, float(state.inputs().light.radiance.detach().mean()))
    told, shown, shown_faintly = explained(observations, positions, state.capture.radius, metal, coloured, faint)
    refuted = torch.zeros_like(metal)
    if told.by_changes:
        refuted = torch.ones_like(metal)
    elif shown.by_none:
        refuted = tells
    coloured, metal = coloured & ~refuted, metal & ~refuted
    shining, faintly, telling = (float(weight[part].sum()) for part in (coloured, faint & ~refuted, tells))
    whole = float(weight.sum())
    if telling > TELLING * whole and shining > MOSTLY * telling:
        state.change("loss.dark", 0.0, "photos", f"{shining / telling:.0%} of what is coloured shines as metals do")
    with torch.no_grad():
        metallic[refuted] = metallic[refuted].clamp(max=raw_metallic(GIVEN.paint))
        if shining > CERTAIN * whole or (faintly > CERTAIN * whole and shown_faintly.by_mirroring):
            metal = torch.ones_like(metal)
            metallic.fill_(raw_metallic(HELD.metal))
            state.learned["held"][:] = True
        else:
            metallic[metal] = metallic[metal].clamp(min=raw_metallic(GIVEN.metal))
    state.learned.forget("metallic", metal | refuted)
    state.part(Metals).found = True
    part = float(weight[metal].sum()) / max(whole, 1e-6)
    state.announce("metals", f"{part:.0%} of the surface shines as metals do", detail=part < TOLD)


@torch.no_grad()
def judge(state: State, step: Step) -> None:
    """Judge again which surfels are metal, by what they mirror (see `mirrored`, `same_material`).

    A surfel that is taken for paint becomes metal if a smooth surface connects it to metals. It takes their base colour and roughness. An
    example is the lower half of a ball on a table: it mirrors only the table, so it has learned the table's colour as its own.

    A metal becomes paint if it looks the same from everywhere, although a metal would mirror different things. Training can still change
    the metallic values that are set here.
    """
    if not state.part(Metals).found:
        return
    surfels, seen, fit = mirrored.fit_both(state)
    found = same_material.decide(surfels, seen, fit)
    names = "metallic", "albedo", "roughness"
    metallic, albedo, roughness = (state.learned[name] for name in names)
    free = ~state.learned["held"]
    raised, lowered = (which.to(metallic.device) & free for which in (found.metal, found.paint))
    like = torch.logit(found.like_metals.clamp(0.02, 0.98)).to(metallic.device)
    metallic[raised], metallic[lowered] = raw_metallic(GIVEN.metal), raw_metallic(GIVEN.paint)
    albedo[raised], roughness[raised] = like[raised, :3], like[raised, 3]
    for name in names:
        state.learned.forget(name, raised | lowered)
    whole = max(float(seen.pixels.sum()), 1e-6)
    parts = [float(seen.pixels[which.cpu()].sum()) / whole for which in (raised, lowered)]
    if max(parts) > TOLD:
        words = f"{parts[0]:.1%} of the surface is of a piece with metals, {parts[1]:.1%} does not mirror as metals do"
        state.announce("mirrored", words, detail=True)
    if parts[0] > TOLD and fit.by_object.any():
        _take_shown_light(state, surfels, seen, found.like_metals)


@torch.no_grad()
def _take_shown_light(state: State, surfels: Surfels, seen: Seen, like_metals: torch.Tensor) -> None:
    """Replace the light by what metals show of it (see `shown_light`), if photos agree with that.

    Under a wrong light, base colours are wrong, too. So all metals take base colour and roughness from `like_metals` (N, 4). Paint takes
    the base colour with which it shows what photos show in the mean.
    """
    learned = state.learned
    metal = (state.surfels().metallic > 0.5).cpu()
    radiance = shown_light.shown_light(state, surfels, seen, metal, like_metals[:, :3])
    if radiance is None:
        return
    before = shown_light.error(state, state.inputs())
    kept = {name: learned[name].clone() for name in ("environment", "albedo", "roughness")}
    which = metal.to(state.device)
    like = torch.logit(like_metals.clamp(0.02, 0.98)).to(state.device)
    learned["environment"].copy_(state.method.light.raw(radiance))
    paint = shown_light.paint_under(radiance, surfels, seen).clamp(0.02, 0.98).to(state.device)
    learned["albedo"].copy_(torch.where(which[:, None], like[:, :3], torch.logit(paint)))
    learned["roughness"][which] = like[which, 3]
    after = shown_light.error(state, state.inputs())
    if after >= before:
        for name, value in kept.items():
            learned[name].copy_(value)
        return
    for name in kept:
        learned.forget(name)
    state.announce("shown light", "the light starts over from what metals show of it, as photos agree", detail=True)


class Doubt(NamedTuple):
    """Hold what photos leave open about metal and paint.

    - `values` (N,): each surfel's doubt (see `same_material.doubt`)
    - `facts`: for metrics.json. `part` is the fraction of the surface whose doubt is at least `questions.DOUBTFUL`. `what` says so to the
      user, if `part` is more than TOLD.
    - `questions`: the largest pieces in doubt
    """

    values: torch.Tensor
    facts: dict[str, float | str]
    questions: list[questions.Question]


@torch.no_grad()
def doubt(state: State) -> Doubt | None:
    """Measure each surfel's doubt: 0 where photos clearly show metal or paint, 1 where they do not show which (see `same_material.doubt`).

    If a part of the surface is in doubt, it is announced to the user. Surfels whose metallic value is held (see `hold`) have doubt 0.
    Returns None if photos do not decide what is metal, for example without specular shading, or if a photo has no mask.
    """
    if not state.from_hull or not metals_decidable(state, state.iteration):
        return None
    surfels, seen, fit = mirrored.fit_both(state)
    values = same_material.doubt(surfels, seen, fit)
    if "held" in state.learned:
        values[state.learned["held"].cpu() & (seen.pixels > same_material.FRINGE)] = 0
    weight = seen.pixels * state.wanted().cpu()
    part = float(weight[values >= questions.DOUBTFUL].sum()) / max(float(weight.sum()), 1e-6)
    facts: dict[str, float | str] = {"part": part}
    if part > TOLD:
        facts["what"] = f"photos do not tell metal from paint on {part:.0%} of the surface"
        state.announce("doubt", facts["what"])
    return Doubt(values, facts, questions.ask(state, surfels, seen, fit, values))


@torch.no_grad()
def hold_as(state: State, kinds: torch.Tensor) -> None:
    """Set and hold metallic values by `kinds` (N,): 0 metal, 1 paint, −1 not held."""
    for number in range(len(HELD)):
        state.learned["metallic"][kinds == number] = raw_metallic(HELD[number])
    state.learned["held"].copy_(kinds >= 0)
    state.learned.forget("metallic", kinds >= 0)
    state.part(Metals).found = True


def hold(state: State) -> None:
    """Zero the gradient of metallic values where `held` (N,) is true."""
    metallic = state.learned.get("metallic")
    if metallic is not None and metallic.grad is not None:
        metallic.grad.masked_fill_(state.learned["held"], 0)
