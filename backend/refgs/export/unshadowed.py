"""Base colours without the object's own shadow, for a mesh on which every renderer casts it again."""

from dataclasses import replace

import torch

from refgs.formats.mesh import Mesh
from refgs.formats.splats import Splats
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.relight import received

LEAST = 0.25  # of the light of an open surface, that one is taken to receive: of deeper hollows light and mesh say too little
PASSES = 3  # for what surfaces send each other goes by the base colours that are looked for: each takes two thirds of the error at least


def unshadowed(splats: Splats, surfels: Surfels, mesh: Mesh, light: Environment) -> Splats:
    """The splats with the base colour of what is matt divided by the part of the irradiance that reaches it past the `mesh`, and
    from it, under the `light` that they were learned in: where no mesh was traced then, the shadow is in their colour. `surfels` are
    the same as tensors."""
    shadowed, occluder = surfels.albedo, Occluder(mesh)
    matt = 1 - surfels.metallic[:, None]
    for _ in range(PASSES):
        with torch.no_grad():
            part = received(surfels, occluder, light).clamp_min(LEAST)
        surfels = surfels._replace(albedo=(shadowed * (1 - matt + matt / part)).clamp(0, 1))
    return replace(splats, albedo=surfels.albedo.numpy())
