"""The splats' materials: a Principled BSDF fed by attributes, and one that shows an attribute as it is."""

import bpy

from ..compat import node_tree
from . import add, out

VALUES_NAME = "RefGS Splat Values"


def splat_material(name: str) -> bpy.types.Material:
    """A new Principled material for the quads of `nodes.splats`: base colour, metallic and roughness of each splat."""
    material = bpy.data.materials.new(name)
    tree = _dithered(material)
    principled = add(
        tree,
        "ShaderNodeBsdfPrincipled",
        {
            "Base Color": _attribute(tree, "base_color", "Color"),
            "Metallic": _attribute(tree, "metallic", "Fac"),
            "Roughness": _attribute(tree, "roughness", "Fac"),
            "Alpha": _alpha(tree),
            "Normal": _normal(tree),
        },
    )
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(principled)})
    return material


def values_material() -> bpy.types.Material:
    """The material `RefGS Splat Values`, shared by all runs: the attribute `display` as light, unlit."""
    if VALUES_NAME in bpy.data.materials:
        return bpy.data.materials[VALUES_NAME]
    material = bpy.data.materials.new(VALUES_NAME)
    tree = _dithered(material)
    emission = add(tree, "ShaderNodeEmission", {"Color": _attribute(tree, "display", "Color")})
    clear = add(tree, "ShaderNodeBsdfTransparent")
    mixed = add(tree, "ShaderNodeMixShader", {"Fac": _alpha(tree), 1: out(clear), 2: out(emission)})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(mixed)})
    return material


def _dithered(material: bpy.types.Material) -> bpy.types.NodeTree:
    # Each Eevee sample keeps or drops a quad at random with its alpha, and the nearest kept one wins: on average this
    # is front-to-back compositing in the order of each pixel's own depths, however many quads overlap.
    material.surface_render_method = "DITHERED"
    return node_tree(material)


def _attribute(tree: bpy.types.NodeTree, name: str, output: str) -> bpy.types.NodeSocket:
    return add(tree, "ShaderNodeAttribute", attribute_name=name).outputs[output]


def _vector(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    return out(add(tree, "ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation))


def _scaled(tree: bpy.types.NodeTree, vector, factor) -> bpy.types.NodeSocket:
    return out(add(tree, "ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE"))


def _math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    return out(add(tree, "ShaderNodeMath", dict(enumerate(inputs)), operation=operation))


def _alpha(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """opacity · exp(-(u² + v²) / 2)."""
    gaussian = _attribute(tree, "gaussian", "Vector")
    exponent = _math(tree, "MULTIPLY", _vector(tree, "DOT_PRODUCT", gaussian, gaussian), -0.5)
    return _math(tree, "MULTIPLY", _attribute(tree, "opacity", "Fac"), _math(tree, "EXPONENT", exponent))


def _normal(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """The splat's own normal, bent across the splat: n + u·dn/du + v·dn/dv, in world space, towards the viewer.

    A splat that is seen from behind shows its other side. Where bending turns the normal away from the viewer, which it does at
    silhouettes, it is brought back to a right angle: a BSDF is black under a normal that faces away.
    """
    u_v = add(tree, "ShaderNodeSeparateXYZ", {"Vector": _attribute(tree, "gaussian", "Vector")}).outputs
    centre = _attribute(tree, "normal", "Vector")
    bent = _vector(tree, "ADD", centre, _scaled(tree, _attribute(tree, "normal_u", "Vector"), u_v["X"]))
    bent = _vector(tree, "ADD", bent, _scaled(tree, _attribute(tree, "normal_v", "Vector"), u_v["Y"]))

    def to_world(vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        kind = {"vector_type": "NORMAL", "convert_from": "OBJECT", "convert_to": "WORLD"}
        return out(add(tree, "ShaderNodeVectorTransform", {"Vector": vector}, **kind))

    viewer = add(tree, "ShaderNodeNewGeometry").outputs["Incoming"]
    side = _math(tree, "SIGN", _dot(tree, to_world(centre), viewer))
    bent = _scaled(tree, _vector(tree, "NORMALIZE", to_world(bent)), side)
    away = _math(tree, "MINIMUM", _dot(tree, bent, viewer), 0.0)
    return _vector(tree, "NORMALIZE", _vector(tree, "SUBTRACT", bent, _scaled(tree, viewer, away)))


def _dot(tree: bpy.types.NodeTree, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    return add(tree, "ShaderNodeVectorMath", {0: a, 1: b}, operation="DOT_PRODUCT").outputs["Value"]
