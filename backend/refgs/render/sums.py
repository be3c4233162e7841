"""Sum images over the pixels of each surfel. A pixel is weighted by the surfel's blending weight in this pixel."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.volume import discs


def pixel_sums(
    surfels: Surfels, camera: Camera, near: float, features: Tensor, weigh: Callable[[Tensor], Tensor]
) -> Tensor:
    """Sum an image over each surfel's pixels, weighted by the surfel's blending weights. Returns the sums (N, C).

    The surfels' `features` (N, C) are drawn as a picture (H, W, C). From this picture, `weigh` computes the image (H, W, C) to sum.
    Autograd computes the sums, as the gradient of Σ picture · image with respect to the features. Surfels nearer to the camera than `near`
    are not drawn.
    """
    features = features.detach().clone().requires_grad_()
    with torch.enable_grad():
        blended = rasterize(*discs(surfels, camera), features, camera, near=near).features
        # A scalar: given a gradient argument, torch imports sympy (0.5 s).
        return torch.autograd.grad((blended * weigh(blended.detach())).sum(), features)[0]


@torch.no_grad()
def blended_shares(
    surfels: Surfels, cameras: Iterable[Camera], near: float, maps: Iterable[Tensor] | None = None
) -> Tensor:
    """Compute how much each surfel contributes to the pictures of V cameras (V, N): the sum of its blending weights over all pixels.

    If `maps` holds an image (H, W, C) for each camera, return instead the mean of these images for each surfel (N, C), weighted by its
    blending weights. Surfels nearer to a camera than `near` are not drawn. `cameras` and `maps` may be generators: only one camera and one
    map are held in memory at a time.
    """
    surfels = Surfels(*(value.detach() for value in surfels))
    one = torch.ones_like(surfels.positions[:, :1])
    if maps is None:
        return torch.stack([pixel_sums(surfels, camera, near, one, torch.ones_like)[:, 0] for camera in cameras])
    rows = []
    for camera, values in zip(cameras, maps, strict=True):
        image = torch.cat([values, torch.ones_like(values[..., :1])], dim=-1)
        rows.append(pixel_sums(surfels, camera, near, one.expand(-1, image.shape[-1]), lambda _, image=image: image))
    total = torch.stack(rows).sum(dim=0)
    return total[:, :-1] / total[:, -1:].clamp_min(1e-6)
