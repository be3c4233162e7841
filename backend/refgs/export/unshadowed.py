"""Remove the object's shadows from base colours: renderers cast shadows on the exported mesh again."""

from dataclasses import replace

import torch

from refgs.formats.mesh import Mesh
from refgs.formats.splats import Splats
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.relight import received

# Lower limit of the received part of the irradiance: in deeper hollows the light and the mesh are too uncertain.
LEAST = 0.25
# Inter-reflection depends on the base colours sought: iterate. Each pass removes two thirds of the error at least.
PASSES = 3


def unshadowed(splats: Splats, surfels: Surfels, mesh: Mesh, light: Environment) -> Splats:
    """Divide the base colour of matte splats by the fraction of the irradiance that reaches them.

    The light that reaches a splat is the direct light that the `mesh` does not block, plus the light that the mesh reflects. Metals are
    unchanged. Call this only if the training traced no mesh: only then do base colours contain shadows. `light` is the training's light,
    and `surfels` are the splats as tensors.
    """
    shadowed, occluder = surfels.albedo, Occluder(mesh)
    matte = 1 - surfels.metallic[:, None]
    for _ in range(PASSES):
        with torch.no_grad():
            part = received(surfels, occluder, light).clamp_min(LEAST)
        surfels = surfels._replace(albedo=(shadowed * (1 - matte + matte / part)).clamp(0, 1))
    return replace(splats, albedo=surfels.albedo.numpy())
