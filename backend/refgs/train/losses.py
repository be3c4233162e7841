"""The objective (paper §3.3): colour, normal consistency, edge-aware smoothness; and the mask."""

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model.environment import Environment
from refgs.render.renderer import COVERED, Rendering, camera_rays, unit
from refgs.render.ssim import dssim
from refgs.settings import LossSettings

SATURATED = 0.998  # a photo's value above which the true radiance is unknown


def color_loss(color: Tensor, photo: Tensor, weight: float) -> Tensor:
    """(1 − λ) L1 + λ D-SSIM on sRGB-encoded (H, W, 3).

    The rendering is clipped only where the photo is: elsewhere an over-bright pixel must feel its gradient.
    """
    color = torch.where(photo >= SATURATED, color.clamp_max(1.0), color)
    loss = (1 - weight) * (color - photo).abs().mean()
    return loss + weight * dssim(color, photo) if weight > 0 else loss


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Unit normals (H − 2, W − 2, 3) of the depth map's surface, towards the camera, by central differences."""
    points = camera_rays(camera) * depth[..., None]
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    return unit(torch.linalg.cross(down, across))


def normal_loss(rendering: Rendering, camera: Camera) -> Tensor:
    """1 − ÑᵀN, Ñ from the depth, where the surface is opaque around the pixel."""
    solid = rendering.alpha.detach() > 0.5
    solid = solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
    normal = unit(rendering.normal[1:-1, 1:-1])
    disagreement = 1 - (depth_normals(rendering.depth, camera) * normal).sum(dim=-1)
    return (disagreement * solid).mean()


def smoothness_loss(rendering: Rendering, photo: Tensor) -> Tensor:
    """‖∇N‖ exp(−‖∇C_gt‖), forward differences, where the surface is opaque."""
    normal, solid = rendering.normal, rendering.alpha.detach() > 0.5
    total = normal.new_zeros(())
    for axis in (0, 1):
        n = photo.shape[axis] - 1
        change = (normal.narrow(axis, 1, n) - normal.narrow(axis, 0, n)).abs().sum(dim=-1)
        edge = (photo.narrow(axis, 1, n) - photo.narrow(axis, 0, n)).abs().sum(dim=-1)
        both = solid.narrow(axis, 1, n) & solid.narrow(axis, 0, n)
        total = total + (change * torch.exp(-edge) * both).mean()
    return total


def light_loss(environment: Environment) -> Tensor:
    """Squared departure from grey of the mean over all directions.

    Warm metal under a neutral light and neutral metal under a warm light look almost alike; without a word for one of
    them, white balance drifts between the two. Only the mean is held: the light's colours may differ by direction.
    """
    mean = environment.irradiance[0]  # the constant harmonic
    return ((mean / mean.mean().clamp_min(1e-9) - 1) ** 2).mean()


def objective(
    rendering: Rendering,
    environment: Environment | None,
    photo: Tensor,
    mask: Tensor | None,
    camera: Camera,
    weights: LossSettings,
    progress: float,
) -> Tensor:
    """The training loss of one view, at a progress of 0..1; terms with weight zero cost nothing."""
    loss = color_loss(rendering.color, photo, weights.dssim)
    if weights.normal > 0:
        loss = loss + weights.normal * normal_loss(rendering, camera)
    if weights.smooth > 0:
        loss = loss + weights.smooth * smoothness_loss(rendering, photo)
    if mask is not None and weights.alpha > 0:
        loss = loss + weights.alpha * (rendering.alpha - mask).abs().mean()
    if rendering.material is not None and weights.metallic > 0:
        # Nothing real is half a metal. Where the metallic is decided, the highlights of dielectrics, 4 % of the light and
        # without colour, fix the light's scale and white balance, which metals alone cannot. Not before it is known
        # which is which, hence the square.
        metallic, covered = rendering.metallic, (rendering.alpha.detach() > COVERED).sum().clamp_min(1)
        loss = loss + weights.metallic * progress**2 * (metallic * (1 - metallic)).sum() / covered
    if environment is not None and weights.light > 0:
        loss = loss + weights.light * light_loss(environment)
    return loss
