"""Photograph a ball of one material under round lamps, by the model itself."""

import math

import torch

from refgs.color import srgb_encode
from refgs.model import cubemap
from tests.makers.training import put

LAMPS = torch.nn.functional.normalize(
    torch.tensor([[1.0, 0.2, 0.5], [-1.0, 0.5, 0.3], [0.1, -1.0, 0.6], [-0.3, -0.4, -1.0], [0.3, 1.0, -0.4]]), dim=1
)  # the directions of round lamps, each 64° wide
DARK = 0.2  # radiance beside the lamps
ORANGE = [2.0, 0.0, -2.0]  # logits: 0.88, 0.5, 0.12


def show(made, *, metallic, roughness, albedo=ORANGE, exposure=(1.0,), turn=False, lamps=LAMPS, lamp=3.0):
    """Replace all photos by renderings of the ball with one material, under a light of random texels.

    Photos are scaled by the factors `exposure`, in turn. With `turn`, the light turns with the camera. `lamps` (L, 3)
    are their directions, `lamp` is their radiance: the photos are clipped above 2. Elsewhere it is DARK.
    """
    state = made.state
    put(made, metallic=metallic, roughness=roughness, albedo=albedo, opacity=4.0)
    if turn:
        state.change("light.frame", "camera", "photos", "the test turns it")
    with torch.no_grad():
        directions = cubemap.texel_directions(math.isqrt(len(state.learned["environment"]) // 6)).float()
        bright = (directions @ lamps.T > 0.85).any(dim=1, keepdim=True)
        state.learned["environment"].copy_(torch.where(bright, lamp, DARK).log().expand(-1, 3))
        inputs = state.inputs()
        for view, photo in enumerate(state.photos):
            factor = 0.5 * exposure[view % len(exposure)]
            seen = state.picture(inputs, photo.camera)
            image = (srgb_encode(factor * seen.radiance).clamp(0, 1) * 255).round().byte()
            alpha = (seen.alpha * 255).round().byte()
            state.photos[view] = photo._replace(image=image, mask=alpha)
