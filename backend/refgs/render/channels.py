"""Collect the surfels' features that deferred shading blends."""

from torch import Tensor

from refgs.camera import Camera
from refgs.model.surfels import Surfels
from refgs.render.directional import directional
from refgs.render.facing import facing_normals
from refgs.render.volume import with_normals_last
from refgs.settings import RenderSettings


def channels(surfels: Surfels, camera: Camera, settings: RenderSettings, indirect: bool) -> list[Tensor]:
    """Collect the features (N, C) of surfels, as a camera sees them, in the order that `shade` reads.

    First come normals and albedo. Unless `reflection` is "none", these follow: metallic and roughness; colour by direction (`diffuse
    = "sh"`) or irradiance divided by that of an unoccluded surface (with `indirect`); radiance from the object itself (with `indirect`);
    positions.
    """
    normals = facing_normals(with_normals_last(surfels).rotations, surfels.positions, camera)
    if settings.reflection == "none":
        return [normals, surfels.albedo]
    lit = [normals, surfels.albedo, surfels.metallic, surfels.roughness]
    if settings.diffuse == "sh":
        lit.append(directional(surfels.sh_dc, surfels.sh_rest, 0.5, surfels.positions, camera))
    elif indirect:
        lit.append(surfels.received)
    if indirect:
        lit.append(directional(surfels.indirect_dc, surfels.indirect_rest, 0.0, surfels.positions, camera, normals))
    return [*lit, surfels.positions]
