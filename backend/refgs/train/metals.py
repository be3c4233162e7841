"""Give surfels a first metallic by how they change with the viewing direction.

Photos of a rough or embossed metal are explained about as well by paint. Training would keep what it starts with, and it starts between
the two. Whether the changing part of the light is tinted tells them apart before normals and light are known.
"""

import torch

from refgs.model.surfels import raw_metallic
from refgs.train.densify import faint_now
from refgs.train.state import State
from refgs.train.view_dependence import metal_or_dielectric, observe

KNOWN = 0.1  # part of the training after which surfels lie near enough to the surface
SOONEST = 100  # iterations
METAL, DIELECTRIC = 0.9, 0.1  # metallic: training can still change both


def set_metals_due(state: State, progress: float) -> None:
    """Once, early in the training, set the metallic of the surfels that change as metals or as dielectrics do.

    See `view_dependence.metal_or_dielectric`. The other surfels keep the metallic that they have learned.
    """
    settings = state.settings
    if state.metals_set or state.initial or not state.method.deferred or "metallic" not in state.parameters:
        return
    if settings.render.reflection != "microfacet" or settings.render.diffuse != "irradiance":
        return
    early = progress - settings.initial.until < KNOWN or state.iteration < SOONEST
    if early or progress >= state.residual_start or faint_now(state):
        return
    with state.clock.part("deciding"):
        observations, metallic = observe(state), state.parameters["metallic"]
        metal, dielectric = metal_or_dielectric(observations, state.parameters["position"].detach())
        with torch.no_grad():
            metallic[metal], metallic[dielectric] = raw_metallic(METAL), raw_metallic(DIELECTRIC)
        moments = state.optimizer.state.get(metallic, {})
        for name in ("exp_avg", "exp_avg_sq") if moments else ():
            moments[name][metal | dielectric] = 0
    state.metals_set = True
    weight = observations.pixels.sum(dim=1) * state.wanted()
    parts = [float(weight[which].sum() / weight.sum().clamp_min(1e-6)) for which in (metal, dielectric)]
    state.announce(
        "metals", f"{parts[0]:.0%} of the surface shines in its own colour, as metals do; {parts[1]:.0%} in the light's"
    )
