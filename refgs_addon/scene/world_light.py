"""The light: a run's recovered panorama, or an HDRI in its place."""

from pathlib import Path

import bpy

from ..errors import InputError
from ..nodes.panorama_world import IMAGE, RECOVERED, ROTATION, STRENGTH, is_panorama, panorama_world

ENDINGS = (".exr", ".hdr")


def hdris(folder: Path | None = None) -> list[Path]:
    """The panoramas that come with Blender, and those in a folder."""
    own = bpy.utils.system_resource("DATAFILES", path="studiolights/world")
    folders = [Path(path) for path in (own, folder) if path]
    files = [file for path in folders if path.is_dir() for file in sorted(path.iterdir())]
    return [file for file in files if file.suffix.lower() in ENDINGS]


def load_panorama(path: Path) -> bpy.types.Image:
    """Load an equirectangular picture (EXR or HDR, linear). Raises InputError where there is none."""
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError:
        raise InputError(f"cannot read the light {path}: choose an EXR or HDR panorama") from None
    if min(image.size) == 0:  # Blender loads what it cannot decode as an empty picture
        bpy.data.images.remove(image)
        raise InputError(f"cannot read the light {path}: it is not a whole EXR or HDR panorama")
    return image


def light_with_recovered(scene: bpy.types.Scene, name: str, image: bpy.types.Image) -> bpy.types.World:
    """A new world, lit by a run's recovered panorama, becomes the scene's."""
    world = panorama_world(name)
    world[RECOVERED] = image
    world.node_tree.nodes[IMAGE].image = image
    scene.world = world
    return world


def relight(scene: bpy.types.Scene, hdri: Path | None, rotation: float = 0.0, strength: float = 1.0) -> None:
    """Light the scene with an HDRI, or with the recovered light again where `hdri` is None.

    `rotation` turns the light about z, in radians, counter-clockwise seen from above; `strength` multiplies it. The
    recovered light stays with the world. A world that RefGS did not make is left as it is and replaced in the scene.
    Raises InputError for a picture that cannot be read, and where there is no recovered light to go back to.
    """
    world = scene.world if is_panorama(scene.world) else None
    if hdri is not None:
        image = load_panorama(hdri)
        if world is None:
            world = scene.world = panorama_world("RefGS Light")
    elif world is not None and world.get(RECOVERED) is not None:
        image = world[RECOVERED]
    else:
        raise InputError("this scene has no recovered light: import a RefGS run that has one")
    nodes = world.node_tree.nodes
    nodes[IMAGE].image = image
    nodes[ROTATION].inputs["Rotation"].default_value = (0.0, 0.0, rotation)
    nodes[STRENGTH].inputs["Strength"].default_value = strength


def match_light(scene: bpy.types.Scene) -> None:
    """Turn and scale the HDRI of a scene so that it lights as the recovered light does, as far as it can: by the rotation at which
    the logarithms of their luminance agree best, and by their mean radiance over the sphere.

    Raises InputError where the scene has no recovered light, or shows it.
    """
    world = scene.world
    if not is_panorama(world) or world.get(RECOVERED) is None:
        raise InputError("this scene has no recovered light to match: import a RefGS run that has one")
    nodes = world.node_tree.nodes
    if nodes[IMAGE].image == world[RECOVERED]:
        raise InputError("the scene is lit by the recovered light: choose an HDRI first, then match it")
    from .panorama import turn_between  # numpy may be missing

    turn, scale = turn_between(nodes[IMAGE].image, world[RECOVERED])
    nodes[ROTATION].inputs["Rotation"].default_value = (0.0, 0.0, turn)
    nodes[STRENGTH].inputs["Strength"].default_value = scale
