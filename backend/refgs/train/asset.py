"""What a training leaves when it has ended: surfels whose materials relight, and the light."""

import json
from typing import Any

import torch
from torch import Tensor

from refgs.capture import write_cameras
from refgs.color import srgb_decode, srgb_encode
from refgs.errors import InputError
from refgs.formats.mesh import write_mesh
from refgs.formats.panorama import write_environment
from refgs.formats.splats import write_splats
from refgs.model import harmonics
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels, to_splats
from refgs.paths import write_text
from refgs.render.rasterize import rasterize
from refgs.render.volume import discs, with_normals_last
from refgs.run import OCCLUDER
from refgs.train import needs
from refgs.train.trainer import Trainer


def write_asset(trainer: Trainer) -> None:
    """Write splats.ply, environment.exr, needs.json and, where they are known, occluder.ply and the exposures in cameras.json."""
    folder, settings = trainer.folder, trainer.settings
    with torch.no_grad():
        surfels, environment = with_normals_last(trainer.surfels()), trainer.environment()
    if not surfels.sh_rest.any():  # it ended before they could learn
        surfels = surfels.without_directions()
    if trainer.occluder is None:
        nothing, whole = surfels.indirect_dc[:, :0], torch.ones_like(surfels.received)
        surfels = surfels._replace(indirect_dc=nothing, indirect_rest=nothing, received=whole)
    else:
        write_mesh(folder / OCCLUDER, trainer.occluder.mesh)
    if environment is not None:
        panorama = environment.panorama(4 * environment.resolution)
        display = settings.render.color_space == "display"
        write_environment(folder / "environment.exr", srgb_decode(panorama) if display else panorama)
        surfels = _with_relightable_albedo(surfels, environment, trainer)
    side, wanted = _seen_from(surfels, trainer), trainer.wanted()
    kept = wanted & (side != 0)
    if not kept.any():
        raise InputError(
            "the photos show nothing in the region: move its box, or enlarge it, and train into a new folder"
        )
    constants = needs.constants(trainer, surfels, kept)
    for name in {*constants} & {*Surfels._fields}:
        surfels = surfels._replace(**{name: torch.full_like(getattr(surfels, name), constants[name])})
    splats = to_splats(surfels.chosen(kept))
    splats.constants = constants
    splats.normals *= side[kept].numpy(force=True)[:, None]
    write_splats(folder / "splats.ply", splats)
    if trainer.exposures is not None:
        factors = trainer.exposures.detach().exp().tolist()
        exposures = {view.camera.name: factor for view, factor in zip(trainer.views, factors, strict=True)}
        write_cameras(folder / "cameras.json", trainer.capture, settings.light.frame, exposures)
    write_text(folder / "needs.json", json.dumps(_left_out(trainer, surfels, side, wanted), indent=1))


def _with_relightable_albedo(surfels: Surfels, environment: Environment, trainer: Trainer) -> Surfels:
    """Albedo under the recovered light, and the SH that a viewer without lights shows.

    Where the diffuse part was learned as SH, a dielectric's albedo is that colour divided by the irradiance it stood in;
    a metal's is its reflectance. Where it was learned as albedo, the SH becomes the matte look under that irradiance.
    """
    received = _received(surfels, environment, trainer)
    metallic = surfels.metallic[:, None]
    if trainer.settings.render.diffuse == "sh":
        sent = (0.5 + harmonics.DC * surfels.sh_dc[:, 0]).clamp_min(0)  # the mean over all directions
        albedo = metallic * surfels.albedo + (1 - metallic) * (sent / received).clamp(0, 1)
        return surfels._replace(albedo=albedo)
    look = (surfels.albedo * received).clamp(0, 1)
    if trainer.settings.render.color_space == "linear":
        look = srgb_encode(look)
    return surfels._replace(sh_dc=((look - 0.5) / harmonics.DC)[:, None])


def _received(surfels: Surfels, environment: Environment, trainer: Trainer) -> Tensor:
    """Irradiance / π of each surfel (N, 3); where the light turned with the camera, its mean over the photos, each by the
    cosine to the camera, either side being looked at."""
    normals = surfels.normals()
    if environment.reference is None:
        return (surfels.received * environment.diffuse(normals)).clamp_min(1e-6)
    total, weights = torch.zeros_like(normals), torch.full_like(normals[:, :1], 1e-6)
    for camera in (view.camera for view in trainer.views):
        towards = torch.from_numpy(camera.position).to(normals) - surfels.positions
        cosine = (torch.nn.functional.normalize(towards, dim=-1) * normals).sum(dim=-1, keepdim=True)
        turn = torch.from_numpy(environment.turn(camera)).to(normals)
        total += cosine.abs() * environment.diffuse(cosine.sign() * normals @ turn.T)
        weights += cosine.abs()
    return (total / weights).clamp_min(1e-6)


def _seen_from(surfels: Surfels, trainer: Trainer) -> Tensor:
    """From which side of each surfel the training views see it (N,): 1 where its normal points to that side, −1 where it points away,
    0 where none sees it; if none sees any, all count as seen.

    A surfel's weight in a view is the gradient of the sum of a constant feature.
    """
    surfels = Surfels(*(value.detach() for value in surfels))
    count = len(surfels.positions)
    side, seen = torch.zeros(count, device=trainer.device), torch.zeros(count, device=trainer.device)
    normals = surfels.normals()
    for view in trainer.views:
        feature = torch.ones(count, 1, device=trainer.device, requires_grad=True)
        raster = rasterize(*discs(surfels, view.camera), feature, view.camera, near=trainer.near)
        raster.features.sum().backward()
        weight = feature.grad[:, 0]
        towards = torch.from_numpy(view.camera.position).float().to(trainer.device) - surfels.positions
        side += weight * torch.sign((normals * towards).sum(dim=-1))
        seen += weight
    known = seen > 0 if (seen > 0).any() else torch.ones_like(seen, dtype=torch.bool)
    return torch.where(side < 0, -1.0, 1.0) * known


def _left_out(trainer: Trainer, surfels: Surfels, side: Tensor, wanted: Tensor) -> list[dict[str, Any]]:
    """What this run was found to need or not, with the figures that say so; what else it did without, why, and what that saved. From
    which `side` (N,) surfels are seen, as `_seen_from` says, and which (N,) are wanted."""
    settings, left = trainer.settings, needs.facts(trainer)
    if settings.render.shading == "sh":
        left.append(
            {"what": "materials and light", "why": "shading = sh", "saved": "shading and the light's prefilter"}
        )
    elif settings.render.diffuse == "irradiance" and surfels.sh_rest.shape[1] == 0:
        per = 3 * (settings.surfels.sh_degree + 1) ** 2
        saved = f"{per} parameters a surfel"
        left.append({"what": "spherical harmonics", "why": "diffuse light comes from the environment", "saved": saved})
    if settings.render.color_space == "display":
        why = "color_space = display: light and base colour are a screen's numbers"
        left.append({"what": "linear radiance", "why": why, "saved": "nothing: relit pictures are off"})
    if settings.render.reflection == "mirror" and settings.render.shading != "sh":
        saved = "four parameters a surfel, and the table of reflectances"
        left.append({"what": "base colour and roughness", "why": "reflection = mirror", "saved": saved})
    if settings.render.shading == "splat":
        saved = "shading pixels; tracing rays"
        left.append({"what": "deferred shading and inter-reflection", "why": "shading = splat", "saved": saved})
    if settings.render.shading == "deferred" and trainer.occluder is None and "reflections" not in trainer.needs:
        indirect = settings.indirect
        why = trainer.without_reflection()
        if not why:
            first = max(indirect.every, max(indirect.start, settings.initial.until) * trainer.total)
            over = trainer.total * trainer.residual_start <= first
            why = "the training was over before its first mesh" if over else "the object hardly mirrors itself"
        saved = "tracing rays, and harmonics of light from the object"
        left.append({"what": "inter-reflection", "why": why, "saved": saved})
    if settings.light.exposure == "auto" and settings.render.shading != "sh" and trainer.exposures is None:
        left.append(
            {
                "what": "exposures",
                "why": "those of the photos agree within a third of a stop",
                "saved": "one number a photo",
            }
        )
    if any(view.alpha is None for view in trainer.views):
        left.append({"what": "the mask loss", "why": "not every photo has a mask", "saved": "one term of the loss"})
    for why, which in (
        ("no training view sees them", wanted & (side == 0)),
        ("they show what is outside the region", ~wanted),
    ):
        if count := int(which.sum()):
            left.append({"what": f"{count} surfels", "why": why, "saved": f"{count} rows of splats.ply"})
    return left
