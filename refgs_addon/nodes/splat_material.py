"""The splats' materials: a Principled BSDF fed by attributes, and one that shows an attribute as it is."""

import bpy

from ..compat import node_tree
from . import add, math, out
from .edit_tree import AMOUNT

VALUES_NAME = "RefGS Splat Values"
COLOR, VECTOR, FACTOR = 0, 1, 2  # the outputs of an Attribute node; the third is Fac up to 4.5 and Factor in 5.2


SPECULAR = "Specular IOR Level"  # as the Principled BSDF calls it
_SURFACE = {"metallic": "Metallic", "roughness": "Roughness", "specular": SPECULAR}


def splat_material(name: str, constants: dict[str, float]) -> bpy.types.Material:
    """A new Principled material for the quads of `nodes.splats`: base colour, metallic and roughness of each splat. What is constant, of
    metallic, roughness and specular, no node reads.

    The back of a splat is black, as the inside of a solid is dark: lit, it would shine through where the splats in
    front of it leave a few per cent uncovered.
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
    black = add(tree, "ShaderNodeEmission", {"Strength": 0.0})
    shader = add(tree, "ShaderNodeMixShader", {0: front, 1: out(black), 2: out(surface)})
    _finish(material, out(shader))
    return material


def principled(material: bpy.types.Material) -> bpy.types.ShaderNode:
    """A material's Principled BSDF, the first if there are several."""
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def read_edits(material: bpy.types.Material) -> None:
    """Have a material of `splat_material` read all that edits change. What mirrors nothing does where an edit makes it of another
    roughness."""
    tree = material.node_tree
    shader = principled(material)
    for key in ("metallic", "roughness"):
        socket = shader.inputs[_SURFACE[key]]
        if not socket.links:
            tree.links.new(_attribute(tree, key, FACTOR), socket)
    specular = shader.inputs[_SURFACE["specular"]]
    if specular.default_value == 0 and not specular.links:
        amount = add(tree, "ShaderNodeSeparateXYZ", {0: _attribute(tree, AMOUNT, VECTOR)}).outputs["Z"]
        tree.links.new(math(tree, "MULTIPLY", amount, 0.5), specular)


def values_material() -> bpy.types.Material:
    """The material `RefGS Splat Values`, shared by all runs: the attribute `display` as light, unlit."""
    if VALUES_NAME in bpy.data.materials:
        return bpy.data.materials[VALUES_NAME]
    material = bpy.data.materials.new(VALUES_NAME)
    tree = node_tree(material)
    _finish(material, out(add(tree, "ShaderNodeEmission", {"Color": _attribute(tree, "display", COLOR)})))
    return material


def _finish(material: bpy.types.Material, shader: bpy.types.NodeSocket) -> None:
    """Show a shader through the splat's alpha, opacity · exp(-(u² + v²) / 2).

    Each Eevee sample keeps or drops a quad at random with its alpha, and the nearest kept one wins: on average this is
    front-to-back compositing in the order of each pixel's own depths, however many quads overlap.
    """
    material.surface_render_method = "DITHERED"
    tree = material.node_tree
    gaussian = _attribute(tree, "gaussian", VECTOR)
    exponent = math(tree, "MULTIPLY", _dot(tree, gaussian, gaussian), -0.5)
    alpha = math(tree, "MULTIPLY", _attribute(tree, "opacity", FACTOR), math(tree, "EXPONENT", exponent))
    clear = add(tree, "ShaderNodeBsdfTransparent")
    mixed = add(tree, "ShaderNodeMixShader", {0: alpha, 1: out(clear), 2: shader})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(mixed)})


def _attribute(tree: bpy.types.NodeTree, name: str, output: int) -> bpy.types.NodeSocket:
    return add(tree, "ShaderNodeAttribute", attribute_name=name).outputs[output]


def _vector(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    return out(add(tree, "ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation))


def _scaled(tree: bpy.types.NodeTree, vector, factor) -> bpy.types.NodeSocket:
    return out(add(tree, "ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE"))


def _dot(tree: bpy.types.NodeTree, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    return add(tree, "ShaderNodeVectorMath", {0: a, 1: b}, operation="DOT_PRODUCT").outputs["Value"]


def _normal(tree: bpy.types.NodeTree) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """The splat's normal bent across the splat, n + u·dn/du + v·dn/dv, in world space; and whether its front is seen.

    Where bending turns the normal away from the viewer, which it does at silhouettes, it is brought back to a right
    angle: a BSDF is black under a normal that faces away.
    """
    u_v = add(tree, "ShaderNodeSeparateXYZ", {"Vector": _attribute(tree, "gaussian", VECTOR)}).outputs
    centre = _attribute(tree, "normal", VECTOR)
    bent = _vector(tree, "ADD", centre, _scaled(tree, _attribute(tree, "normal_u", VECTOR), u_v["X"]))
    bent = _vector(tree, "ADD", bent, _scaled(tree, _attribute(tree, "normal_v", VECTOR), u_v["Y"]))

    def to_world(vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        kind = {"vector_type": "NORMAL", "convert_from": "OBJECT", "convert_to": "WORLD"}
        return out(add(tree, "ShaderNodeVectorTransform", {"Vector": vector}, **kind))

    viewer = add(tree, "ShaderNodeNewGeometry").outputs["Incoming"]
    front = math(tree, "GREATER_THAN", _dot(tree, to_world(centre), viewer), 0.0)
    bent = _vector(tree, "NORMALIZE", to_world(bent))
    away = math(tree, "MINIMUM", _dot(tree, bent, viewer), 0.0)
    return _vector(tree, "NORMALIZE", _vector(tree, "SUBTRACT", bent, _scaled(tree, viewer, away))), front
