"""Remove the object's shadows from its base colours. Renderers add the shadows themselves when they light the exported mesh."""

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
    """Return splats whose base colours have no shadows and no inter-reflection.

    Use this only if the training did not compute shadows: then the learned base colours contain shadows and inter-reflection. The base
    colour of a matte splat is divided by a ratio: the irradiance with the mesh, divided by the irradiance without it. The irradiance with
    the mesh consists of direct light that `mesh` does not block and of light that `mesh` reflects. Metals are unchanged. `surfels` are the
    same splats as tensors. `light` is the recovered light.
    """
    shadowed, occluder = surfels.albedo, Occluder(mesh)
    matte = 1 - surfels.metallic[:, None]
    for _ in range(PASSES):
        with torch.no_grad():
            part = received(surfels, occluder, light).clamp_min(LEAST)
        surfels = surfels._replace(albedo=(shadowed * (1 - matte + matte / part)).clamp(0, 1))
    return replace(splats, albedo=surfels.albedo.numpy())
