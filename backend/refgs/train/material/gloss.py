"""Find paint that is glossier than it has learned.

A highlight that is rendered beside its place in a photo is worse than none. So paint becomes rough although photos show highlights, and
stays so: too rough is a local minimum, too sharp is not. But how much radiance varies from photo to photo does not depend on where
highlights are exactly. If it varies more in photos than in renderings, the paint is glossier.

That needs renderings that are sharp elsewhere: while photos are reduced and normals err, all paint varies too little in them.
"""

import math

import torch
from torch import Tensor

from refgs.color import srgb_decode
from refgs.model.surfels import Surfels
from refgs.render.sums import pixel_sums
from refgs.train import probe
from refgs.train.material import base_colors
from refgs.train.material.observe import LEAST_PIXELS, neighbours, pooled
from refgs.train.state import RenderInputs, State

NEAR = 9  # neighbours whose radiance is averaged, so that noise of pixels does not count
GLOSSIER = 0.5  # factor on roughness in the second rendering, which tells how the variance depends on it
LEAST = 0.2  # roughness; glossier paint learns by itself
LEARNED = 0.7  # standard deviation of the logarithm of learned roughness; no step is larger
MODEL = 0.6  # standard deviation of the logarithm of the variances' ratio, if roughness is right
DARK = 1e-9  # variance


@torch.no_grad()
def roughest(state: State, paint: Tensor, seed: int) -> Tensor:
    """Tell how rough `paint` (N,) is at most, (N,); 1 elsewhere. Each `seed` takes other photos.

    The logarithm of the variance is taken as linear in that of roughness: a rendering of glossier paint gives the slope. By Bayes' rule for
    normal distributions, the step is what LEARNED and MODEL leave. Where variance hardly depends on roughness, nothing is told.
    """
    if not paint.any():
        return torch.ones_like(state.learned["roughness"])
    inputs = state.inputs()
    learned = inputs.surfels.roughness
    other = base_colors.plausible(torch.where(paint, GLOSSIER * learned, learned))
    glossier = inputs._replace(surfels=inputs.surfels._replace(roughness=other))
    views = probe.random_views(state, seed, probe.SEVERAL)
    sums = torch.stack([_sums(state, view, inputs, glossier) for view in views], dim=1)
    photo, shown, other = (_variances(inputs.surfels, sums, paint) + DARK).log().unbind(dim=1)
    slope = ((other - shown) / -math.log(GLOSSIER)).clamp_min(0)
    step = LEARNED**2 * slope * (photo - shown) / ((LEARNED * slope).square() + MODEL**2)
    found = learned.clamp_min(LEAST) * (-step.clamp(-LEARNED, LEARNED)).exp()
    return torch.where(paint, found.clamp(LEAST, 1), 1)


def _sums(state: State, view: int, *inputs: RenderInputs) -> Tensor:
    """Sum each surfel's pixels (N, I + 2): the linear grey radiance in the photo and in the rendering of each of the I `inputs`, and 1.

    Pixels that mirror the object do not count. How much those of rough paint vary is not rendered well.
    """
    photo, surfels = state.photo(view), inputs[0].surfels
    shown = [probe.picture(state, view, each) for each in inputs]
    pictures = photo.encoded, *(each.color for each in shown)
    grey = [srgb_decode(picture.clamp(0, 1)).mean(dim=-1) for picture in pictures]
    images = torch.stack([*grey, torch.ones_like(grey[0])], dim=-1) * shown[0].mirrors_light[..., None]
    features = torch.ones_like(surfels.positions[:, :1]).expand(-1, images.shape[-1])
    return pixel_sums(surfels, photo.camera, state.near, features, lambda _: images)


def _variances(surfels: Surfels, sums: Tensor, paint: Tensor) -> Tensor:
    """Return how much `sums` (N, V, C + 1) over pixels, the last column is their weight, vary over V photos: (N, C), up to a common factor.

    They are averaged over neighbours that are `paint` (N,) and have like colours.
    """
    near = neighbours(surfels.positions, NEAR, paint)
    radiance, pixels = pooled(sums * paint[:, None, None], near).split([sums.shape[2] - 1, 1], dim=2)
    weight = pixels * (pixels > LEAST_PIXELS * math.sqrt(NEAR))
    each = radiance / pixels.clamp_min(1e-6)
    mean = (weight * each).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True).clamp_min(1e-6)
    varies = torch.zeros_like(sums[:, 0, :-1])
    varies[paint] = (weight * (each - mean).square()).sum(dim=1)
    return base_colors.spread_alike(
        varies, surfels, base_colors.plausible(surfels.albedo).log(), paint, surfels.opacities
    )
