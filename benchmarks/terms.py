"""Which part of a run stands in the way: true maps in place of its own, in turn, shaded as in training.

Only what the object covers is compared, under its true mask. Base colours and light share one scale a channel that photos do
not tell, so each picture is measured after the scale a channel of its radiance that fits the truth best.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.compare import metrics
from refgs.compare.pictures import over_white
from refgs.compare.truth import GroundTruth, read_relit
from refgs.model.environment import Environment
from refgs.render.rasterize import rasterize
from refgs.render.renderer import channels
from refgs.render.shade import shade
from refgs.render.stack import stack
from refgs.render.volume import discs
from refgs.run import Run, open_run

PARTS = ("normals", "materials", "light", "visibility")


def terms(folder: Path, truth: Path) -> dict[str, float]:
    """PSNR in dB, mean over the views with ground truth, of a run "as it is", with each of `PARTS` true, and with "all" of them."""
    run = open_run(folder)
    known = GroundTruth(truth, run.to_capture)
    light = Environment.from_panorama(known.panorama("light"), run.environment.resolution)
    side, found = run.settings.image.max_side, {}
    for camera in (c for c, split in zip(run.cameras, run.splits, strict=True) if split == "test"):
        for name, value in _view(run, known, light, camera.fitted(side)).items():
            found.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


@torch.no_grad()
def _view(run: Run, truth: GroundTruth, light: Environment, camera: Camera) -> dict[str, float]:
    rendering, surfels, inter_reflects = run.render(camera), run.surfels(), run.occluder is not None
    matte = run.settings.render.reflection == "none"
    lit = channels(surfels, camera, run.settings.render, inter_reflects)
    features, _, alpha = rasterize(*discs(surfels, camera), stack(lit), camera, near=run.near)
    others = features[..., 8:-3] / alpha.clamp_min(1e-6)[..., None]  # colour by direction, light from the object
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    # Every blend is of its own pixel's point: nothing is displaced.
    points = pixels.double() @ torch.from_numpy(camera.camera_to_world[:3, :3].T) + torch.from_numpy(camera.position)

    true = {name: torch.from_numpy(np.ascontiguousarray(truth.view(name, camera))).float() for name in truth.passes}
    true_materials = torch.cat([true["albedo"], true["metallic"][..., None], true["roughness"][..., None]], dim=-1)
    opaque = torch.ones_like(alpha)
    photo = read_relit(truth.folder / "color" / f"{camera.name}.exr", (camera.height, camera.width))

    def decibels(parts: tuple[str, ...]) -> float:
        normal = true["normal"] if "normals" in parts else rendering.normal
        material = true_materials if "materials" in parts else rendering.material
        visibility = true["visibility"] if "visibility" in parts else rendering.visibility
        dull = matte and "materials" not in parts
        maps = [normal, material[..., :3]] if dull else [normal, material, others, points.float()]
        given = opaque, light if "light" in parts else run.environment, camera, torch.ones(3)
        by_direction = run.settings.render.diffuse == "sh"
        shaded = shade(
            torch.cat(maps, dim=-1),
            *given,
            visibility if inter_reflects else None,
            by_direction=by_direction,
            matte=dull,
        )
        return _fitted(shaded.radiance, photo)

    rows = {"as it is": decibels(())} | {name: decibels((name,)) for name in PARTS}
    return rows | {"all": decibels(PARTS)}


def _fitted(radiance: Tensor, photo: np.ndarray) -> float:
    alpha = photo[..., 3:]
    image = radiance.numpy() * alpha
    # Where neither is brighter than a screen: a few suns would decide it.
    seen = (np.maximum(image, photo[..., :3]).max(-1) < 1) & (alpha[..., 0] > metrics.COVERED)
    aa, ab = ((image[seen] * other[seen][:, :3]).sum(0, dtype=np.float64) for other in (image, photo))
    image = image * np.where(aa > 0, ab / np.where(aa > 0, aa, 1), 1).astype(np.float32)
    return metrics.psnr(over_white(np.dstack([image, alpha])), over_white(photo))
