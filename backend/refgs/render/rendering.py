"""Hold the result of rendering a camera."""

from dataclasses import dataclass

from torch import Tensor

from refgs.color import srgb_decode

COVERED = 1 / 255  # pixels with less alpha than this are background


@dataclass(frozen=True)
class Rendering:
    """Picture of a camera, and the maps that were shaded.

    `color` (H, W, 3) is sRGB-encoded, over the background. The maps are alpha-weighted means over the surfels of a pixel:
    linear, zero where nothing is. `normal` (H, W, 3) is in world space, faces the camera, and is not normalised. `depth` (H, W)
    is along the camera's axis; `blended_depth` is the sum of depths before the division by alpha. With a light, `material` (H, W, 5) is
    albedo, metallic, roughness. With inter-reflection, `visibility` (H, W) is 0 where the object occludes the mirror
    direction, else 1. `background` (3,) and `exposure`, a scalar, are the arguments of `render`.
    """

    color: Tensor
    alpha: Tensor
    blended_depth: Tensor
    normal: Tensor
    material: Tensor | None = None
    visibility: Tensor | None = None
    background: Tensor | None = None
    exposure: Tensor | None = None

    @property
    def depth(self) -> Tensor:
        return self.blended_depth / self.alpha.clamp_min(COVERED)

    @property
    def radiance(self) -> Tensor:
        """Linear radiance (H, W, 3) from the surfels of a pixel to the camera, before exposure; zero where nothing is."""
        alpha = self.alpha[..., None]
        mean = (self.color - (1 - alpha) * self.background) / alpha.clamp_min(COVERED)
        radiance = srgb_decode(mean.clamp_min(0)) * (alpha > COVERED)
        return radiance if self.exposure is None else radiance / self.exposure

    @property
    def albedo(self) -> Tensor:
        return self.material[..., :3]

    @property
    def metallic(self) -> Tensor:
        return self.material[..., 3]

    @property
    def roughness(self) -> Tensor:
        return self.material[..., 4]
