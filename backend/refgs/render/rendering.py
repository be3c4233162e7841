"""Define `Rendering`, the result of rendering a camera."""

from dataclasses import dataclass

import torch
from torch import Tensor

from refgs.color import srgb_decode

COVERED = 1 / 255  # pixels with less alpha than this are background
SOLID = 0.5  # alpha from which on a pixel shows the surface


@dataclass(frozen=True)
class Rendering:
    """Hold the picture of a camera, and the maps from which it was shaded.

    `color` (H, W, 3) is sRGB-encoded and includes the background. `alpha` (H, W) is the coverage by surfels. These maps are means over the
    surfels of each pixel, weighted as they are blended, and zero where no surfel is:

    - `normal` (H, W, 3): in world space, towards the camera, not normalised
    - `depth` (H, W): along the camera's axis; `blended_depth` is `depth` times alpha
    - `material` (H, W, 5): albedo (linear), metallic, roughness; None without a light

    `visibility` (H, W) is 0 where the object occludes the mirror direction, else 1; None without inter-reflection. `background` (3,) and
    `exposure` (3,) are the arguments of `render`; without them, the background is black and the exposure 1.
    """

    color: Tensor
    alpha: Tensor
    blended_depth: Tensor
    normal: Tensor
    material: Tensor | None = None
    visibility: Tensor | None = None
    background: Tensor | float = 0.0
    exposure: Tensor | None = None

    @property
    def depth(self) -> Tensor:
        return self.blended_depth / self.alpha.clamp_min(COVERED)

    @property
    def radiance(self) -> Tensor:
        """Compute pixels' linear radiance (H, W, 3) without background and exposure, 0 where empty."""
        alpha = self.alpha[..., None]
        mean = (self.color - (1 - alpha) * self.background) / alpha.clamp_min(COVERED)
        radiance = srgb_decode(mean.clamp_min(0)) * (alpha > COVERED)
        return radiance if self.exposure is None else radiance / self.exposure

    @property
    def mirrors_light(self) -> Tensor:
        """Tell in which pixels (H, W) the object does not occlude the mirror direction: all without inter-reflection."""
        return torch.ones_like(self.alpha).bool() if self.visibility is None else self.visibility > 0.5

    @property
    def albedo(self) -> Tensor:
        return self._known_material[..., :3]

    @property
    def metallic(self) -> Tensor:
        return self._known_material[..., 3]

    @property
    def roughness(self) -> Tensor:
        return self._known_material[..., 4]

    @property
    def _known_material(self) -> Tensor:
        if self.material is None:
            raise ValueError("a rendering without a light has no material")
        return self.material
