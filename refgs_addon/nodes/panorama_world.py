"""Build the node tree of a Blender world that shows a panorama with a rotation and a strength."""

from collections.abc import Sequence

import bpy

from ..compat import node_tree
from . import add, out

# Names of the nodes that the panel shows and `scene.world_light` sets.
IMAGE, ROTATION, STRENGTH = "RefGS HDRI", "RefGS Rotation", "RefGS Strength"
RECOVERED = "refgs_recovered"  # custom property of a world: the run's recovered panorama


def panorama_world(name: str) -> bpy.types.World:
    """Make a world that shows a panorama. The image is set later.

    Its Mapping node has the type Texture: a rotation about z then rotates the environment itself, counter-clockwise seen from above.
    """
    world = bpy.data.worlds.new(name)
    # By default Eevee moves all radiance above 10 into one sun lamp, which makes several softboxes a single hard sun. Without that,
    # a relit jar came 3 dB closer to Cycles under a studio HDRI, 0.4 dB under a courtyard.
    world.sun_threshold = 0.0
    tree = node_tree(world)
    direction = add(tree, "ShaderNodeTexCoord").outputs["Generated"]
    mapping = add(tree, "ShaderNodeMapping", {"Vector": direction}, name=ROTATION, vector_type="TEXTURE")
    image = add(tree, "ShaderNodeTexEnvironment", {"Vector": out(mapping)}, name=IMAGE)
    background = add(tree, "ShaderNodeBackground", {"Color": out(image)}, name=STRENGTH)
    add(tree, "ShaderNodeOutputWorld", {"Surface": out(background)})
    return world


def is_panorama(world: bpy.types.World | None) -> bool:
    """Check whether a world comes from `panorama_world` and still has its nodes."""
    return (
        world is not None
        and world.node_tree is not None
        and {IMAGE, ROTATION, STRENGTH} <= set(world.node_tree.nodes.keys())
    )


def get_light(world: bpy.types.World) -> tuple[bpy.types.Image | None, tuple[float, ...], float]:
    """Read a panorama world's image, rotation (Euler angles) and strength."""
    nodes = world.node_tree.nodes
    rotation, strength = nodes[ROTATION].inputs["Rotation"], nodes[STRENGTH].inputs["Strength"]
    return nodes[IMAGE].image, tuple(rotation.default_value), strength.default_value


def set_light(
    world: bpy.types.World, image: bpy.types.Image | None, rotation: Sequence[float], strength: float
) -> None:
    """Set a panorama world's image, rotation (Euler angles) and strength."""
    nodes = world.node_tree.nodes
    nodes[IMAGE].image = image
    nodes[ROTATION].inputs["Rotation"].default_value = rotation
    nodes[STRENGTH].inputs["Strength"].default_value = strength
