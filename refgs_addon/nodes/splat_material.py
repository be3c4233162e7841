"""Build the splats' materials. One is a Principled BSDF that reads attributes. The other shows a single attribute without lighting."""

import bpy

from ..compat import node_tree
from . import add, math, out, principled, scaled, vector_math
from .edit_tree import AMOUNT
from .kept_tree import OPENED
from .splats_tree import EXTENT, draws_splats
from .world_diffuse import surface_inputs

VALUES_NAME = "RefGS Splat Values"
COLOR, VECTOR, FACTOR = 0, 1, 2  # outputs of an Attribute node; the third is called Fac up to 4.5, Factor in 5.2
SPECULAR = "Specular IOR Level"  # the Principled BSDF's name
_SURFACE = {"metallic": "Metallic", "roughness": "Roughness", "specular": SPECULAR}


def splat_material(name: str, constants: dict[str, float], two_sided: bool = False) -> bpy.types.Material:
    """Make a Principled material for what `nodes.splats_tree` draws. It reads each splat's base colour, metallic and roughness.

    `constants` maps "metallic", "roughness" or "specular" to one value for all splats. The material then uses this value, and not the
    splats' own.

    The back of a splat is black, like the inside of a solid. A lit back would shine through the small gaps between the front splats. Once
    splats are deleted, one looks into the object, and black would be a crust on the cut: backs are matte, as no photo shows their gloss.
    With `two_sided`, each normal is turned to the viewer instead, for splats whose normals point to either side.
    """
    material = bpy.data.materials.new(name)
    tree = node_tree(material)
    normal, front = _normal(tree)
    surface = add(
        tree,
        "ShaderNodeBsdfPrincipled",
        {
            "Base Color": _attribute(tree, "base_color", COLOR),
            **{socket: constants[key] for key, socket in _SURFACE.items() if key in constants},
            "Normal": normal,
        },
    )
    for key in ("metallic", "roughness"):
        if key not in constants:
            tree.links.new(_attribute(tree, key, FACTOR), surface.inputs[_SURFACE[key]])
    if not two_sided:
        black = add(tree, "ShaderNodeEmission", {"Strength": 0.0})
        matte = add(tree, "ShaderNodeBsdfDiffuse", {"Color": _attribute(tree, "base_color", COLOR), "Normal": normal})
        opened = _attribute(tree, OPENED, FACTOR)
        back = add(tree, "ShaderNodeMixShader", {0: opened, 1: out(black), 2: out(matte)})
        surface = add(tree, "ShaderNodeMixShader", {0: front, 1: out(back), 2: out(surface)})
    _finish(material, out(surface))
    return material


def connect_edits(material: bpy.types.Material) -> None:
    """Change a material of `splat_material` so that it shows edits: modifiers that change the splats' materials.

    Afterwards, the material reads metallic and roughness from each splat, even if it had one value for all splats before. With a specular
    of 0, the roughness of a non-metal would have no effect. So splats with edited roughness also get a specular above 0.
    """
    tree = material.node_tree
    shader = principled(material)
    sockets = surface_inputs(material)
    for key in ("metallic", "roughness"):
        unlinked = [socket for socket in sockets[_SURFACE[key]] if not socket.links]
        if unlinked:
            value = _attribute(tree, key, FACTOR)
            for socket in unlinked:
                tree.links.new(value, socket)
    specular = shader.inputs[_SURFACE["specular"]]
    if specular.default_value == 0 and not specular.links:
        amount = add(tree, "ShaderNodeSeparateXYZ", {0: _attribute(tree, AMOUNT, VECTOR)}).outputs["Z"]
        tree.links.new(math(tree, "MULTIPLY", amount, 0.5), specular)


def values_material() -> bpy.types.Material:
    """Make or reuse the material that shows the attribute `display` without lighting."""
    if VALUES_NAME in bpy.data.materials:
        return bpy.data.materials[VALUES_NAME]
    material = bpy.data.materials.new(VALUES_NAME)
    tree = node_tree(material)
    _finish(material, out(add(tree, "ShaderNodeEmission", {"Color": _attribute(tree, "display", COLOR)})))
    return material


def _finish(material: bpy.types.Material, shader: bpy.types.NodeSocket) -> None:
    """Give a splat its Gaussian alpha, unless Blender does, and connect its `shader` to the material's output."""
    # In each of its samples, Eevee draws a splat with a probability equal to its alpha, and the nearest one drawn is visible. The mean over
    # the samples equals alpha compositing of the splats, sorted by depth in each pixel.
    material.surface_render_method = "DITHERED"
    tree = material.node_tree
    if draws_splats():
        add(tree, "ShaderNodeOutputMaterial", {"Surface": shader})
        return
    gaussian = _attribute(tree, "gaussian", VECTOR)
    exponent = math(tree, "MULTIPLY", vector_math(tree, "DOT_PRODUCT", gaussian, gaussian), -0.5)
    alpha = math(tree, "MULTIPLY", _attribute(tree, "opacity", FACTOR), math(tree, "EXPONENT", exponent))
    clear = add(tree, "ShaderNodeBsdfTransparent")
    mixed = add(tree, "ShaderNodeMixShader", {0: alpha, 1: out(clear), 2: shader})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(mixed)})


def _attribute(tree: bpy.types.NodeTree, name: str, output: int) -> bpy.types.NodeSocket:
    return add(tree, "ShaderNodeAttribute", attribute_name=name).outputs[output]


def _normal(tree: bpy.types.NodeTree) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """Add nodes for a curved splat's world-space normal, turned to the viewer, and its visible side (1 front, 0 back)."""
    u, v = _place(tree)
    centre = _attribute(tree, "normal", VECTOR)
    bent = vector_math(tree, "ADD", centre, scaled(tree, _attribute(tree, "normal_u", VECTOR), u))
    bent = vector_math(tree, "ADD", bent, scaled(tree, _attribute(tree, "normal_v", VECTOR), v))

    def to_world(vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        kind = {"vector_type": "NORMAL", "convert_from": "OBJECT", "convert_to": "WORLD"}
        return out(add(tree, "ShaderNodeVectorTransform", {"Vector": vector}, **kind))

    viewer = add(tree, "ShaderNodeNewGeometry").outputs["Incoming"]
    facing = vector_math(tree, "DOT_PRODUCT", to_world(centre), viewer)
    front = math(tree, "GREATER_THAN", facing, 0.0)
    bent = scaled(tree, vector_math(tree, "NORMALIZE", to_world(bent)), math(tree, "SIGN", facing))
    # Near silhouettes the normal can point away from the viewer, and a BSDF would be black: it is turned until it is perpendicular.
    away = math(tree, "MINIMUM", vector_math(tree, "DOT_PRODUCT", bent, viewer), 0.0)
    return vector_math(tree, "NORMALIZE", vector_math(tree, "SUBTRACT", bent, scaled(tree, viewer, away))), front


def _place(tree: bpy.types.NodeTree) -> list[bpy.types.NodeSocket]:
    """Add nodes for the position on the splat along its two axes, in standard deviations."""
    if not draws_splats():
        return add(tree, "ShaderNodeSeparateXYZ", {"Vector": _attribute(tree, "gaussian", VECTOR)}).outputs[:2]
    # Blender's splats face the viewer. Intersect the line of sight with the splat's plane, in the object's coordinates.
    geometry = add(tree, "ShaderNodeNewGeometry").outputs
    space = {"convert_from": "WORLD", "convert_to": "OBJECT"}
    position, viewer = (
        out(add(tree, "ShaderNodeVectorTransform", {"Vector": geometry[name]}, vector_type=kind, **space))
        for name, kind in (("Position", "POINT"), ("Incoming", "VECTOR"))
    )
    axes = [_attribute(tree, name, VECTOR) for name in ("gaussian_u", "gaussian_v")]
    away = vector_math(tree, "SUBTRACT", position, _attribute(tree, "gaussian_centre", VECTOR))
    plane = vector_math(tree, "NORMALIZE", vector_math(tree, "CROSS_PRODUCT", *axes))
    height, slant = (vector_math(tree, "DOT_PRODUCT", vector, plane) for vector in (away, viewer))
    hit = vector_math(tree, "SUBTRACT", away, scaled(tree, viewer, math(tree, "DIVIDE", height, slant)))
    places = (vector_math(tree, "DOT_PRODUCT", hit, axis) for axis in axes)
    return [math(tree, "MAXIMUM", math(tree, "MINIMUM", place, EXTENT), -EXTENT) for place in places]
