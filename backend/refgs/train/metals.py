"""Give surfels a first metallic by how they change with the viewing direction.

Photos of a rough or embossed metal are explained about as well by paint, and training starts near paint: it would stay there. The tint of
what changes with the view tells them apart before normals and light are known.

Where nearly all of the surface shines as coloured metals do, metallic no longer learns: photos alone would turn some of it into paint
again, since roughness, light and base colour explain rough metal and paint about as well.
"""

import torch

from refgs.model.surfels import raw_metallic
from refgs.train import needs
from refgs.train.changing_light import explained
from refgs.train.needs.materials import SOONEST
from refgs.train.state import State
from refgs.train.view_dependence import falls_as_metal, observe, shines_as_metal

KNOWN = 0.1  # part of the training after which surfels lie near enough to the surface
METAL, PAINT = 0.9, 0.02  # metallic; training can still change it
CERTAIN = 0.85  # part of the surface that shines as coloured metals do, above which all is metal; a gold cape has 0.95, matte clay 0.71
LIT = 0.25  # part of the changes that a light which changed explains, from which on it may be all; matte clay has 0.32
MIRRORED = 0.05  # part of the changes that only mirroring explains, below which the light changed; a gold cape has 0.17, matte clay 0.03
HELD = torch.tensor(
    raw_metallic(0.98)
)  # raw metallic that is held; surfels that have exactly this value are known by it


def set_metals_due(state: State, progress: float) -> None:
    """Once, early in the training, raise the metallic of the surfels that change with the view as only metals do.

    See `shines_as_metal` for coloured metals, `falls_as_metal` for all. If a light that changed from photo to photo explains the changes,
    and mirroring hardly any of the rest (see `changing_light.explained`), none is metal, and the metallic learned so far is lowered.

    If nearly all shine as coloured metals do, all are metal from then on (see `hold`). Otherwise the others keep the metallic that they
    have learned: it started low, as that of a dielectric.

    Schedules that propagate normals find metals by that, as the paper does: nothing is set there.
    """
    settings = state.settings
    early = progress - settings.initial.until < KNOWN or state.iteration < SOONEST
    if state.metals_set or early or progress >= state.residual_start:
        return
    if settings.render.reflection != "microfacet" or settings.propagation.every or not needs.decidable(state):
        return
    observations, metallic = observe(state), state.parameters["metallic"]
    positions, weight = state.parameters["position"].detach(), observations.pixels.sum(dim=1) * state.wanted()
    light = float(state.environment().radiance.detach().mean())
    coloured = shines_as_metal(observations, positions)
    metal = coloured | falls_as_metal(observations, positions, light)
    lit, mirrored = explained(observations, positions, state.capture.radius, metal)
    with torch.no_grad():
        if lit > LIT and mirrored < MIRRORED:
            coloured, metal = torch.zeros_like(metal), torch.zeros_like(metal)
            metallic.clamp_(max=raw_metallic(PAINT))
        if float(weight[coloured].sum()) > CERTAIN * float(weight.sum()):
            metal = torch.ones_like(metal)
            metallic.fill_(float(HELD))
        else:
            metallic[metal] = metallic[metal].clamp(min=raw_metallic(METAL))
    moments = state.optimizer.state.get(metallic, {})
    for name in ("exp_avg", "exp_avg_sq") if moments else ():
        moments[name][metal] = 0
    state.metals_set = True
    part = float(weight[metal].sum() / weight.sum().clamp_min(1e-6))
    state.announce("metals", f"{part:.0%} of the surface shines as metals do")


def hold(state: State) -> None:
    """Remove the gradient of the metallic of surfels that are held, so that it stays. Halves of a divided surfel are held, too."""
    metallic = state.parameters.get("metallic")
    if state.metals_set and metallic is not None and metallic.grad is not None:
        metallic.grad.masked_fill_(metallic.detach() == HELD.to(metallic), 0)
