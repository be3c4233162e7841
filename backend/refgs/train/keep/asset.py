"""Write the asset of a training that has ended: surfels whose materials can be relit, and the environment's light."""

import json
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.capture import write_cameras
from refgs.errors import InputError
from refgs.formats.exr import write_exr
from refgs.formats.mesh import write_mesh
from refgs.formats.splats import write_splats
from refgs.model import harmonics
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels, to_splats
from refgs.paths import write_text
from refgs.render.composite import blended_normals
from refgs.render.facing import facing_cosine
from refgs.render.sums import blended_shares
from refgs.render.volume import with_normals_last
from refgs.run import OCCLUDER
from refgs.run_folder import SPLATS, update_metrics
from refgs.spread import spread
from refgs.train.decide import needs
from refgs.train.decide.need import Given
from refgs.train.keep.questions import write_questions
from refgs.train.learn import poses
from refgs.train.learn.exposures import exposure
from refgs.train.learn.poses import Poses
from refgs.train.material import metals
from refgs.train.plan import doubt
from refgs.train.state import State, why_not_traced


def write_asset(state: State, before_splats: Callable[[], None] = lambda: None) -> None:
    """Write the results of a training into its run folder.

    These are the surfels (splats.ply), the light (environment.exr), and the optional features that the training left out or kept
    (needs.json). If inter-reflection was traced, the object's mesh is written to occluder.ply. If exposures or poses were learned,
    cameras.json is written again to include them. If photos decide what is metal, each surfel's doubt is added to splats.ply, and facts
    about it to metrics.json (see `metals.doubt`). Questions about pieces in doubt are written to questions.json.

    splats.ply is written last, because a run that has it counts as finished. `before_splats` is called just before. Raises InputError if
    the photos show no surfel in the region to train.
    """
    with torch.no_grad():
        surfels = with_normals_last(state.surfels())
    for rewrite in REWRITES:
        surfels = rewrite(surfels, state)
    side, wanted = _seen_side(surfels, state), state.wanted()
    kept = wanted & (side != 0)
    if not kept.any():
        advice = "move its box, or enlarge it, and train into a new folder"
        raise InputError(f"the photos show nothing in the region: {advice}")
    surfels, constants = _with_constants(surfels, state, kept)
    splats = to_splats(surfels.chosen(kept))
    splats.constants = constants
    what = "what photos leave open about metals"
    found = metals.doubt(state) if state.plan.pays_at_end(what, doubt(len(state.views))) else None
    if found:
        splats.doubt = found.values.numpy()[kept.numpy(force=True)]
        update_metrics(state.folder, {"doubt": found.facts})
    write_questions(state.folder, found.questions if found else [], surfels.positions, kept)
    splats.normals *= side[kept].numpy(force=True)[:, None]
    splats.normals = blended_normals(splats)
    _write_light_and_mesh(state)
    _write_refined_cameras(state)
    write_text(state.folder / "needs.json", json.dumps(_needs_rows(state, surfels, side, wanted), indent=1))
    before_splats()
    write_splats(state.folder / SPLATS, splats)


def _without_unlearned(surfels: Surfels, state: State) -> Surfels:
    """Drop the residual colour if the training ended before it could learn."""
    return surfels if surfels.sh_rest.any() else surfels.without_directions()


def _without_untraced(surfels: Surfels, state: State) -> Surfels:
    """Without a mesh, drop the surfels' inter-reflected light and set `received` to 1."""
    if state.occluder is not None:
        return surfels
    nothing, whole = surfels.indirect_dc[:, :0], torch.ones_like(surfels.received)
    return surfels._replace(indirect_dc=nothing, indirect_rest=nothing, received=whole)


@torch.no_grad()
def _with_relightable_albedo(surfels: Surfels, state: State) -> Surfels:
    """If the scene has a light, give the surfels both an albedo and SH colours."""
    # Programs that light surfels use the albedo, programs that only display them the SH colours. Whichever was not learned is computed from
    # the other by the irradiance; metals take the learned reflectance.
    environment = state.environment()
    if environment is None:
        return surfels
    received = _irradiance(surfels, environment, state)
    metallic = surfels.metallic[:, None]
    if state.settings.render.diffuse == "sh":
        sent = (0.5 + harmonics.DC * surfels.sh_dc[:, 0]).clamp_min(0)  # the mean over all directions
        albedo = metallic * surfels.albedo + (1 - metallic) * (sent / received).clamp(0, 1)
        return surfels._replace(albedo=albedo)
    look = state.method.light.encode((surfels.albedo * received).clamp(0, 1))
    return surfels._replace(sh_dc=((look - 0.5) / harmonics.DC)[:, None])


REWRITES = (_without_unlearned, _without_untraced, _with_relightable_albedo)
"""Changes to the surfels before they are written, in this order: base colours depend on whether `received` was traced."""


def _with_constants(surfels: Surfels, state: State, kept: Tensor) -> tuple[Surfels, dict[str, float]]:
    """Find out which of metallic and roughness are nearly equal in all surfels, and make these exactly equal.

    splats.ply then needs no column for them. Returns the surfels, and the common values by name. Only surfels whose entry in `kept` (N,) is
    true are compared. Without specular shading, all surfels get metallic 0 and roughness 1, and the values include specular 0.
    """
    if state.settings.render.reflection == "none" and state.method.lit:
        constants = {"metallic": 0.0, "roughness": 1.0, "specular": 0.0}
    else:
        common = needs.CONSTANTS.common(state, surfels, kept)
        needs.evaluate(state, "asset", Given(state.iteration, common=common, kept=int(kept.sum())))
        constants = {name: value for name, (value, _) in common.items()}
    same = {name: constants[name] for name in {*constants} & {*Surfels._fields}}
    return surfels._replace(**{n: torch.full_like(getattr(surfels, n), value) for n, value in same.items()}), constants


def _write_light_and_mesh(state: State) -> None:
    """Write environment.exr if there is a light, and occluder.ply if inter-reflection was traced."""
    if state.occluder is not None:
        write_mesh(state.folder / OCCLUDER, state.occluder.mesh)
    with torch.no_grad():
        if (environment := state.environment()) is not None:
            panorama = environment.panorama(4 * environment.resolution)
            write_exr(state.folder / "environment.exr", state.method.light.to_linear(panorama))


def _write_refined_cameras(state: State) -> None:
    """Write cameras.json again if exposures or poses were learned."""
    factors, refined = exposure(state, slice(None)), state.part(Poses).values is not None
    if factors is None and not refined:
        return
    exposures = None
    if factors is not None:
        exposures = {view.camera.name: factor for view, factor in zip(state.views, factors.tolist(), strict=True)}
    frame = state.settings.light.frame
    write_cameras(state.folder / "cameras.json", poses.refined(state), frame, exposures, refined)


def _irradiance(surfels: Surfels, environment: Environment, state: State) -> Tensor:
    """Compute each surfel's irradiance / π (N, 3), averaged over photos if the light turns."""
    normals = surfels.normals()
    if environment.reference is None:
        return (surfels.received * environment.diffuse(normals)).clamp_min(1e-6)
    total, weights = torch.zeros_like(normals), torch.full_like(normals[:, :1], 1e-6)
    for camera in _cameras(state):
        cosine = facing_cosine(surfels.positions, normals, camera)[:, None]
        turn = torch.from_numpy(environment.turn(camera)).to(normals)
        total += cosine.abs() * environment.diffuse(cosine.sign() * normals @ turn.T)
        weights += cosine.abs()
    return (total / weights).clamp_min(1e-6)


def _cameras(state: State) -> list[Camera]:
    """Return the cameras of the photos, with refined poses; or of some, evenly spaced, if there is little time."""
    return [photo.camera for photo in spread(state.photos, state.plan.views_at_end())]


def _seen_side(surfels: Surfels, state: State) -> Tensor:
    """Find out which side of each surfel (N,) the training views see.

    1 is the side that the normal points to, −1 is the other side, and 0 means that no view sees the surfel. If no view sees any surfel, the
    result is 1 for all.
    """
    surfels = Surfels(*(value.detach() for value in surfels))
    normals = surfels.normals()
    side = seen = torch.zeros(len(normals), device=state.device)
    for camera in _cameras(state):
        weight = blended_shares(surfels, [camera], state.near)[0]
        side = side + weight * facing_cosine(surfels.positions, normals, camera).sign()
        seen = seen + weight
    known = seen > 0 if (seen > 0).any() else torch.ones_like(seen, dtype=torch.bool)
    return torch.where(side < 0, -1.0, 1.0) * known


def _needs_rows(state: State, surfels: Surfels, side: Tensor, wanted: Tensor) -> list[dict[str, Any]]:
    """Return the rows of needs.json: features left out or kept, with reason and saving."""
    settings, method, left = state.settings, state.method, needs.rows(state)

    def add(what: str, why: str, saved: str) -> None:
        left.append({"what": what, "why": why, "saved": saved})

    if method.lit and settings.render.diffuse == "irradiance" and surfels.sh_rest.shape[1] == 0:
        per = 3 * (settings.surfels.sh_degree + 1) ** 2
        add("spherical harmonics", "diffuse light comes from the environment", f"{per} parameters a surfel")
    left += method.left_out
    for what, part in state.plan.left_out.items():
        add(what, f"it would take {part:.0%} of the time given", "time for iterations")
    if method.deferred and state.occluder is None and "reflections" not in state.needs:
        why = why_not_traced(state) or _why_no_mesh(state)
        add("inter-reflection", why, "tracing rays, and harmonics of light from the object")
    if settings.light.exposure == "auto" and method.lit and "exposure" not in state.learned:
        add("exposures", "those of the photos agree within a third of a stop", "three numbers a photo")
    if "exposure" in state.learned and state.learned["exposure"].shape[1] == 1:
        add("white balances", "those of the photos agree within a tenth", "two numbers a photo")
    if any(view.alpha is None for view in state.views):
        add("the mask loss", "not every photo has a mask", "one term of the loss")
    for why, which in (
        ("no training view sees them", wanted & (side == 0)),
        ("they show what is outside the region", ~wanted),
    ):
        if count := int(which.sum()):
            add(f"{count} surfels", why, f"{count} rows of splats.ply")
    return left


def _why_no_mesh(state: State) -> str:
    """Explain why a run with inter-reflection switched on never made a mesh."""
    indirect = state.settings.indirect
    first = max(indirect.every, max(indirect.start, state.settings.initial.until) * state.total)
    over = state.total * state.residual_start <= first
    return "the training was over before its first mesh" if over else "the object hardly mirrors itself"
