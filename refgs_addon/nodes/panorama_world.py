"""The world's tree: a panorama with a rotation and a strength."""

import bpy

from ..compat import node_tree
from . import add, out

# The nodes whose values the panel shows and `scene.relight` sets.
IMAGE, ROTATION, STRENGTH = "RefGS HDRI", "RefGS Rotation", "RefGS Strength"
RECOVERED = "refgs_recovered"  # the world's custom property that keeps a run's recovered panorama


def panorama_world(name: str) -> bpy.types.World:
    """A new world lit by a panorama, still without its image.

    The mapping is of the type Texture, so that a rotation about z turns the light itself by that angle,
    counter-clockwise seen from above.
    """
    world = bpy.data.worlds.new(name)
    # Eevee would take what is brighter than 10 out of the panorama and put it into one lamp: several softboxes become a
    # single hard sun. Left in, a relit jar came 3 dB closer to Cycles under a studio HDRI, 0.4 dB under a courtyard.
    world.sun_threshold = 0.0
    tree = node_tree(world)
    direction = add(tree, "ShaderNodeTexCoord").outputs["Generated"]
    mapping = add(tree, "ShaderNodeMapping", {"Vector": direction}, name=ROTATION, vector_type="TEXTURE")
    image = add(tree, "ShaderNodeTexEnvironment", {"Vector": out(mapping)}, name=IMAGE)
    background = add(tree, "ShaderNodeBackground", {"Color": out(image)}, name=STRENGTH)
    add(tree, "ShaderNodeOutputWorld", {"Surface": out(background)})
    return world


def is_panorama(world: bpy.types.World | None) -> bool:
    """Whether a world was made by `panorama_world`, and still has the nodes that are set."""
    return (
        world is not None
        and world.node_tree is not None
        and {IMAGE, ROTATION, STRENGTH} <= set(world.node_tree.nodes.keys())
    )
