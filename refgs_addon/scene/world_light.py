"""Light the scene with the panorama recovered from a run's photos, or with an HDRI."""

from pathlib import Path

import bpy

from ..errors import InputError
from ..nodes.panorama_world import IMAGE, RECOVERED, get_light, is_panorama, panorama_world, set_light
from ..nodes.world_diffuse import NAME, UNIFORM, set_harmonics, set_rotation
from ..ordinary import check_file

ENDINGS = (".exr", ".hdr")
LIGHT = "refgs_light"  # custom property of the node group that corrects diffuse light: the name of the panorama that it is set to


def hdris(folder: Path | None = None) -> list[Path]:
    """List the panorama files (EXR or HDR) that come with Blender, then those in `folder`."""
    own = bpy.utils.system_resource("DATAFILES", path="studiolights/world")
    folders = [Path(path) for path in (own, folder) if path]
    files = [file for path in folders if path.is_dir() for file in sorted(path.iterdir())]
    return [file for file in files if file.suffix.lower() in ENDINGS]


def load_panorama(path: Path) -> bpy.types.Image:
    """Load an equirectangular panorama (EXR or HDR, linear). Raises InputError where it cannot be read."""
    try:
        check_file(path)
        image = bpy.data.images.load(str(path))
    except (OSError, RuntimeError):
        raise InputError(f"cannot read the light {path}: choose an EXR or HDR panorama") from None
    if min(image.size) == 0:  # Blender loads a file that it cannot decode as an empty image
        bpy.data.images.remove(image)
        raise InputError(f"cannot read the light {path}: it is not a complete EXR or HDR panorama")
    return image


def light_with_recovered(scene: bpy.types.Scene, name: str, image: bpy.types.Image) -> bpy.types.World:
    """Give the scene a new world with `image`, the panorama of a run's recovered light. The file keeps it when it is not used, too."""
    world = panorama_world(name)
    world.use_fake_user = True
    world[RECOVERED] = image
    world.node_tree.nodes[IMAGE].image = image
    scene.world = world
    return world


def relight(scene: bpy.types.Scene, hdri: Path | None, rotation: float = 0.0, strength: float = 1.0) -> None:
    """Light the scene with an HDRI. With `hdri` None, light it again with the panorama recovered from the run's photos.

    `rotation` rotates the environment about z, in radians, counter-clockwise seen from above; `strength` multiplies its radiance. The
    scene's world remembers the recovered panorama. A world that RefGS did not make is not changed: the scene gets a new one, and the file
    keeps the old one. Raises InputError if the HDRI cannot be read, or there is no recovered panorama.
    """
    world = scene.world if is_panorama(scene.world) else None
    if hdri is not None:
        image = load_panorama(hdri)
        if world is None:
            keep_world(scene.world)
            world = scene.world = panorama_world("RefGS Light")
    elif world is not None and world.get(RECOVERED) is not None:
        image = world[RECOVERED]
    else:
        raise InputError("this scene has no recovered light: import a RefGS run that has one")
    _check_image(world, image)
    set_light(world, image, (0.0, 0.0, rotation), strength)
    correct_diffuse(scene)


def _check_image(world: bpy.types.World, image: bpy.types.Image | None) -> None:
    """Raise InputError if a panorama's file is missing, and the panorama is not packed into the .blend."""
    if image is None or min(image.size) == 0:
        fix = "press Find Run Folder in the panel Run" if image == world.get(RECOVERED) else "choose the HDRI again"
        name = bpy.path.abspath(image.filepath) if image else "the world's image"
        raise InputError(f"{name} does not exist: {fix}")


def keep_world(world: bpy.types.World | None) -> None:
    """Make Blender save a world that no scene uses any more."""
    if world is not None:
        world.use_fake_user = True


def match_light(scene: bpy.types.Scene) -> None:
    """Rotate the scene's HDRI and change its strength, to match the light recovered from the run's photos.

    The rotation is the one at which the log luminances agree best. The strength makes the mean luminances over the sphere equal. Raises
    InputError if the scene has no recovered light, or is lit by that light already.
    """
    world = scene.world
    if not is_panorama(world) or world.get(RECOVERED) is None:
        raise InputError("this scene has no recovered light to match: import a RefGS run that has one")
    image, _, _ = get_light(world)
    if image == world[RECOVERED]:
        raise InputError("the scene is lit by the recovered light: choose an HDRI first, then match it")
    for panorama in (image, world[RECOVERED]):
        _check_image(world, panorama)
    from .panorama import best_rotation  # needs numpy, which Debian's Blender may lack

    rotation, scale = best_rotation(image, world[RECOVERED])
    set_light(world, image, (0.0, 0.0, rotation), scale)
    correct_diffuse(scene)


def correct_diffuse(scene: bpy.types.Scene) -> None:
    """Update the node group that corrects Eevee's diffuse light on imported runs. Call this after the scene's world has changed.

    If RefGS did not make the world, the group corrects nothing. See `nodes.world_diffuse`.
    """
    tree = bpy.data.node_groups.get(NAME)
    if tree is None:
        return
    image, rotation, _ = get_light(scene.world) if is_panorama(scene.world) else (None, (0.0,) * 3, 0.0)
    light = image.name if image is not None and min(image.size) > 0 else ""
    if tree.get(LIGHT) != light:
        tree[LIGHT] = light
        if light:
            from .panorama import diffuse_light

            set_harmonics(tree, diffuse_light(image))
        else:
            set_harmonics(tree, UNIFORM)
    set_rotation(tree, rotation)
