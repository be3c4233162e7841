"""Render by the methods of other papers, for comparison with RefGS.

`method_of` reads the settings below and returns the method. The default is RefGS's own: deferred shading in linear radiance.

- `shading = "splat"`: each surfel is shaded before blending, as in the initial stage of the Ref-Gaussian paper (§3.3).
- `shading = "sh"`: each surfel has its own view-dependent colour, as in 2DGS. There are no materials and no light.
- `reflection = "mirror"`: a sharp mirror image of the light, weighted by metallic (Ye et al., 3DGS-DR, 2024).
- `color_space = "display"`: light and materials are sRGB-encoded values in 0..1, as in the Ref-Gaussian paper.
- `primitive = "3dgs"`: 3D Gaussians instead of surfels (`refgs.render.volume`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.color import srgb_decode, srgb_encode
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.channels import channels
from refgs.render.directional import directional
from refgs.render.facing import facing_normals
from refgs.render.rasterize import rasterize
from refgs.render.rendering import COVERED, Rendering
from refgs.render.shade import shade_splats
from refgs.render.stack import stack
from refgs.render.volume import discs, with_normals_last
from refgs.settings import RenderSettings, SurfelSettings

MIRROR_LOGIT = 7.0  # of a perfect mirror: the logit of its base colour, and the negated one of its roughness


class LinearLight:
    """Represent light by linear HDR radiance. Pictures show it sRGB-encoded.

    Raw texels are logarithms. So a step of Adam changes a lamp by as large a part as a dark wall: lamps are hundreds of times as bright.
    """

    display = False
    brightest = math.log(1e8)  # raw texel; beyond it, sums lose what is small

    def radiance(self, raw: Tensor) -> Tensor:
        """Convert raw texels to radiance. Raw texels are the trained parameters of the light."""
        return raw.exp()

    def raw(self, radiance: Tensor) -> Tensor:
        """Convert radiance to raw texels. This is the inverse of `radiance()`."""
        return radiance.log()

    def encode(self, radiance: Tensor) -> Tensor:
        """Convert radiance to the values that a picture stores."""
        return srgb_encode(radiance)

    def to_linear(self, panorama):
        """Convert a panorama (float array) from this representation of light to linear radiance."""
        return panorama

    def from_linear(self, panorama):
        """Convert a panorama (float array) from linear radiance to this representation of light."""
        return panorama


class ScreenLight(LinearLight):
    """Represent light by sRGB-encoded values in 0..1. Pictures show these values unchanged."""

    display = True
    brightest = 12.0  # raw texel; beyond it, float32's logistic function has no slope

    def radiance(self, raw: Tensor) -> Tensor:
        return torch.sigmoid(raw)

    def raw(self, radiance: Tensor) -> Tensor:
        return radiance.logit()

    def encode(self, radiance: Tensor) -> Tensor:
        return radiance

    def to_linear(self, panorama):
        return srgb_decode(panorama)

    def from_linear(self, panorama):
        return srgb_encode(panorama)


LINEAR, SCREEN = LinearLight(), ScreenLight()


@dataclass(frozen=True)
class Method:
    """Describe a method of rendering surfels. The defaults describe RefGS's own method.

    - `lit`: false if the method has no materials and no light
    - `deferred`: true if the surfels' features are blended first, and then each pixel is shaded
    - `mirror`: true if reflections are a sharp mirror image of the light
    - `light`: how the values of the light represent radiance
    - `draw`: a function that replaces deferred shading; it takes the arguments of `render`. None keeps deferred shading.
    - `unread`: names of the surfels' parameters that do not affect pictures. They are not trained.
    - `constants`: parameters that are the same for all surfels, {name: value before the activation function}. They are not trained.
    - `left_out`: the features of RefGS that the method lacks, as rows of needs.json. Each row has three texts: "what" names the feature,
      "why" gives the reason, and "saved" says what leaving it out saves.
    """

    lit: bool = True
    deferred: bool = True
    mirror: bool = False
    light: LinearLight = LINEAR
    draw: Callable[..., Rendering] | None = None
    unread: tuple[str, ...] = ()
    constants: dict[str, float] = field(default_factory=dict)
    left_out: tuple[dict[str, str], ...] = ()


@lru_cache
def method_of(settings: RenderSettings) -> Method:
    """Return the rendering method that the settings select."""
    method = Method()
    if settings.shading == "sh":
        row = {"what": "materials and light", "why": "shading = sh", "saved": "shading and the light's prefilter"}
        unread = ("albedo", "metallic", "roughness")
        method = Method(lit=False, deferred=False, draw=draw_colors, unread=unread, left_out=(row,))
    if settings.color_space == "display":
        why = "color_space = display: light and base colour are a screen's numbers"
        row = {"what": "linear radiance", "why": why, "saved": "nothing: relit pictures are off"}
        method = replace(method, light=SCREEN, left_out=(*method.left_out, row))
    if settings.reflection == "mirror" and method.lit:
        saved = "four parameters a surfel, and the table of reflectances"
        row = {"what": "base colour and roughness", "why": "reflection = mirror", "saved": saved}
        constants = {"albedo": MIRROR_LOGIT, "roughness": -MIRROR_LOGIT}
        method = replace(method, mirror=True, constants=constants, left_out=(*method.left_out, row))
    if settings.shading == "splat":
        saved = "shading pixels; tracing rays"
        row = {"what": "deferred shading and inter-reflection", "why": "shading = splat", "saved": saved}
        method = replace(method, deferred=False, draw=draw_shaded_surfels, left_out=(*method.left_out, row))
    return method


def initial_stage(settings: RenderSettings) -> RenderSettings:
    """Copy the settings, changed to shade surfels before blending (Ref-Gaussian paper, §3.3)."""
    return settings.model_copy(update={"shading": "splat"})


def axes_of(settings: SurfelSettings) -> int:
    """Return a splat's number of scales: 3 for a 3D Gaussian, 2 for a surfel."""
    return 3 if settings.primitive == "3dgs" else 2


def draw_colors(
    surfels: Surfels,
    environment: None,
    camera: Camera,
    background: Tensor,
    settings: RenderSettings,
    near: float,
    occluder: None = None,
    exposure: None = None,
) -> Rendering:
    """Blend the surfels' own view-dependent, sRGB-encoded colours, without materials or light."""
    normals = facing_normals(with_normals_last(surfels).rotations, surfels.positions, camera)
    colors = directional(surfels.sh_dc, surfels.sh_rest, 0.5, surfels.positions, camera)
    features, depth, alpha = rasterize(*discs(surfels, camera), stack([normals, colors]), camera, near=near)
    over = (1 - alpha[..., None]) * background
    normal, color = features.split(3, dim=-1)
    mean = normal / alpha.clamp_min(COVERED)[..., None]
    return Rendering(color + over, alpha, depth, mean, background=background)


def draw_shaded_surfels(
    surfels: Surfels,
    environment: Environment,
    camera: Camera,
    background: Tensor,
    settings: RenderSettings,
    near: float,
    occluder: None = None,
    exposure: Tensor | None = None,
) -> Rendering:
    """Shade each surfel, then blend the results, without tracing reflections (Ref-Gaussian paper, §3.3)."""
    method, matte = method_of(settings), settings.reflection == "none"
    lit = channels(surfels, camera, settings, indirect=False)
    blended = [lit[0], shade_splats(stack(lit), environment, camera, method.mirror), *lit[1 : 2 if matte else 4]]
    features, depth, alpha = rasterize(*discs(surfels, camera), stack(blended), camera, near=near)
    over = (1 - alpha[..., None]) * background
    means = features / alpha.clamp_min(COVERED)[..., None]
    normal, mean, material = means.split((3, 3, 3 if matte else 5), dim=-1)
    if matte:  # metallic 0, roughness 1
        material = torch.cat([material, alpha.new_tensor([0.0, 1.0]).expand(*alpha.shape, 2)], dim=-1)
    encoded = method.light.encode(mean if exposure is None else exposure * mean)
    color = encoded * alpha[..., None] + over
    return Rendering(color, alpha, depth, normal, material, None, background, exposure)
