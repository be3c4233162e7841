"""Collect the features of surfels that are blended before deferred shading."""

from torch import Tensor

from refgs.camera import Camera
from refgs.model.surfels import Surfels
from refgs.render.directional import directional
from refgs.render.facing import facing_normals
from refgs.render.volume import with_normals_last
from refgs.settings import RenderSettings


def channels(surfels: Surfels, camera: Camera, settings: RenderSettings, indirect: bool) -> list[Tensor]:
    """List the surfels' features that are blended for a picture and then shaded: tensors (N,) or (N, C), in the order that `shade` reads.

    - normal, albedo; the list ends here if `settings.reflection` is "none"
    - metallic, roughness
    - view-dependent colour, if `settings.diffuse` is "sh"
    - irradiance divided by that of an unoccluded surface, if `settings.diffuse` is not "sh" and `indirect` is true
    - radiance that comes from the object itself in the mirror direction, if `indirect` is true
    - position
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
