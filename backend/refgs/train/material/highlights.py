"""Tell how bright lamps are by highlights of paint.

Photos clip what mirrors a lamp. So they hardly tell the lamp's radiance from the base colour of paint: under a lamp twice as bright, paint
half as bright looks the same. But its highlights do not. A dielectric of index of refraction 1.5 mirrors 4 %, whatever its colour is, so
few of its highlights are clipped.

The light of all highlights is summed, in photos and in renderings. The sum of a blurred or displaced highlight is that of a sharp one. How
much it depends on the lamps is told by a rendering with brighter lamps: where most highlights are clipped, little.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.color import srgb_decode
from refgs.render.rendering import Rendering
from refgs.train import probe
from refgs.train.learn import exposures
from refgs.train.photo import Photo
from refgs.train.state import RenderInputs, State

OPAQUE = 0.98  # alpha of a pixel, at least
VIEWS = 4  # photos that are compared at a time
SHINES = 0.02  # radiance of a highlight, at least: half of what a dielectric mirrors of a white wall
REACH = 1 / 60  # of the photo's longer side, by which highlights may be displaced
METALLIC = 0.1  # of a pixel of paint, at most
GLOSSY = 0.4  # roughness of paint, at most: base colours learn what wider highlights lack
LEAST = 0.05  # ratio: where photos have no highlight, errors of what is below may be larger than it
MODEL = 0.15  # standard deviation of the logarithm, if highlights tell without noise
BRIGHTER = 0.2  # paint's base colour is darker by this logarithm, in the rendering with brighter lamps


class Told(NamedTuple):
    """Hold a natural logarithm and its variance."""

    log: float
    variance: float


@torch.no_grad()
def compare(state: State, brighter: RenderInputs, seed: int) -> Told | None:
    """Compare highlights of paint in photos with those in renderings: by which logarithm lamps should be brighter, and so paint darker.

    `brighter` is rendered with paint that is darker by BRIGHTER. Each `seed` takes other photos. Returns None where nothing shines, or
    where highlights do not depend on lamps.
    """
    ways = state.inputs(), brighter
    matte = [each._replace(environment=each.light.without_reflections()) for each in ways]
    views = probe.random_views(state, seed, VIEWS)
    sums = []
    for view in views:
        photo, exposure = state.photo(view), exposures.exposure(state, view)
        pictures = [state.picture(each, photo.camera, exposure) for each in (*ways, *matte)]
        sums.append(_light(photo, *pictures))
    seen, rendered, brightened = torch.stack(sums).double().unbind(dim=1)
    whole, more = float(rendered.sum()), float(brightened.sum())
    if whole <= 0 or more <= whole or (rendered > 0).sum() < 2:
        return None
    slope = math.log(more / whole) / BRIGHTER
    ratio = max(float(seen.sum()) / whole, LEAST)
    # Variance of a ratio of sums over photos.
    noise = float((seen - ratio * rendered).square().sum()) * len(views) / (len(views) - 1) / whole**2
    return Told(math.log(ratio) / slope, (MODEL**2 + noise / ratio**2) / slope**2)


def _light(photo: Photo, shown: Rendering, brighter: Rendering, matte: Rendering, matte_brighter: Rendering) -> Tensor:
    """Sum the light of highlights of paint: (3,), in the photo and in the renderings `shown` and `brighter`."""
    pictures = photo.encoded, shown.color, brighter.color, matte.color, matte_brighter.color
    seen, *rendered, base, other = (srgb_decode(x.clamp(0, 1)) for x in pictures)
    paint = (shown.alpha > OPAQUE) & (shown.metallic < METALLIC) & (shown.roughness < GLOSSY) & shown.mirrors_light
    if photo.mask is not None:
        paint &= photo.mask > 255 * OPAQUE
    highlights = [
        (light - dull).mean(dim=-1) for light, dull in zip((seen, *rendered), (base, base, other), strict=True)
    ]
    reach = max(1, round(REACH * max(photo.image.shape[:2])))
    near = torch.nn.functional.max_pool2d((highlights[1] * paint)[None], 2 * reach + 1, stride=1, padding=reach)[0]
    where = paint & (near > SHINES)
    return torch.stack([(light * where).sum() for light in highlights])
