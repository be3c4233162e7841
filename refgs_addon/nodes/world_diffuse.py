"""Correct the diffuse light of the world in Eevee, by a node group that the materials of runs share.

For diffuse surfaces, Eevee keeps only the first two bands (degrees 0 and 1) of spherical harmonics of the world's light. It weakens the
second band if the sum of both could be negative. So the bright side of an object is up to a third too dark, and its dark side is too
bright. The group multiplies the base colour by the true irradiance, and divides it by Eevee's. Three bands give the true irradiance within
1 % (Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment Maps").
"""

from collections.abc import Sequence

import bpy
from mathutils import Euler, Vector

from ..compat import EEVEE, EEVEE_WINDOW_BY_LENGTH
from . import add, add_input, math, out, principled, scaled, vector_math

NAME = "RefGS World Diffuse"  # the group, and its node in a material
BANDS = (0.28209479177387814, 0.4886025119029199)  # constants of the first two bands
# Constants of the third band, for xy, yz, 3z² − 1, xz and x² − y².
THIRD = (1.0925484305920792, 1.0925484305920792, 0.31539156525252005, 1.0925484305920792, 0.5462742152960396)
UNIFORM = [(1.0,) * 3, *[(0.0,) * 3] * 8]  # harmonics of a white light from all sides
MOST = 3.0  # largest factor; more would show where Eevee's irradiance is nearly zero
LOBE = (1.0, 2 / 3, 1 / 4)  # harmonics of the cosine lobe, over π, by band
ROTATION = "Panorama's Rotation"  # node that turns the normal into the panorama's frame
_WINDOW = "Eevee's Second Band"


def world_diffuse_group() -> bpy.types.ShaderNodeTree:
    """Make the node group `RefGS World Diffuse`, or return the existing one. It changes nothing until `set_harmonics` is called.

    Inputs: the surface's Base Color, Metallic, Normal (world space) and Occlusion (1 where nothing blocks the light). Output: the base
    colour for Eevee. Occlusion darkens the world's diffuse light, which Eevee does not shadow. Metals have no diffuse light, and keep their
    colour. In other engines a driver switches the group off.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = bpy.data.node_groups.new(NAME, "ShaderNodeTree")
    add_input(tree, "Base Color", "Color", default_value=(0.8, 0.8, 0.8, 1.0))
    add_input(tree, "Metallic", "Float")
    add_input(tree, "Normal", "Vector", hide_value=True)
    add_input(tree, "Occlusion", "Float", default_value=1.0)
    tree.interface.new_socket("Base Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    group = add(tree, "NodeGroupInput").outputs

    # Irradiance over π, in red, green and blue: the sum of nine vectors, each times a polynomial of the normal.
    x, y, z = add(tree, "ShaderNodeSeparateXYZ", {0: group["Normal"]}).outputs
    twice = math(tree, "MULTIPLY_ADD", math(tree, "MULTIPLY", z, z), 3.0, -1.0)
    difference = math(tree, "SUBTRACT", math(tree, "MULTIPLY", x, x), math(tree, "MULTIPLY", y, y))
    third = [
        math(tree, "MULTIPLY", x, y),
        math(tree, "MULTIPLY", y, z),
        twice,
        math(tree, "MULTIPLY", x, z),
        difference,
    ]
    terms = []
    for number, polynomial in enumerate([None, x, y, z, *third]):
        vector = out(add(tree, "ShaderNodeCombineXYZ", name=_term(number)))
        terms.append(vector if polynomial is None else scaled(tree, vector, polynomial))

    def total(values: list[bpy.types.NodeSocket]) -> bpy.types.NodeSocket:
        result = values[0]
        for value in values[1:]:
            result = vector_math(tree, "ADD", result, value)
        return result

    second, window = total(terms[1:4]), out(add(tree, "ShaderNodeValue", name=_WINDOW))
    true = total([terms[0], second, *terms[4:]])
    eevees = vector_math(tree, "ADD", terms[0], scaled(tree, second, window))
    ratio = vector_math(tree, "DIVIDE", scaled(tree, true, group["Occlusion"]), eevees)
    ratio = vector_math(tree, "MINIMUM", vector_math(tree, "MAXIMUM", ratio, (0.0,) * 3), (MOST,) * 3)

    switch = add(tree, "ShaderNodeValue", label="Only in Eevee")
    _switch_off_elsewhere(out(switch))
    amount = math(tree, "MULTIPLY", math(tree, "SUBTRACT", 1.0, group["Metallic"]), out(switch))
    factor = scaled(tree, vector_math(tree, "SUBTRACT", ratio, (1.0,) * 3), amount)
    factor = vector_math(tree, "ADD", factor, (1.0,) * 3)
    add(tree, "NodeGroupOutput", {"Base Color": vector_math(tree, "MULTIPLY", group["Base Color"], factor)})
    set_harmonics(tree, UNIFORM)
    return tree


def _term(number: int) -> str:
    return f"Harmonic {number}"


def _switch_off_elsewhere(value: bpy.types.NodeSocket) -> None:
    """Drive a Value node: 1 if Eevee renders the scene, otherwise 0."""
    driver = value.driver_add("default_value").driver
    variable = driver.variables.new()
    variable.name, variable.type = "engine", "CONTEXT_PROP"
    variable.targets[0].context_property, variable.targets[0].data_path = "ACTIVE_SCENE", "render.engine"
    engines = bpy.types.RenderSettings.bl_rna.properties["engine"].enum_items
    driver.expression = f"engine == {engines[EEVEE].value}"


def set_harmonics(tree: bpy.types.ShaderNodeTree, harmonics: Sequence[Sequence[float]]) -> None:
    """Set the world's light, before its rotation, in the node group `tree`.

    `harmonics` (9, 3) are spherical-harmonic coefficients of the irradiance over π, in Blender's working space, as Eevee's are. They belong
    to the polynomials 1; x, y, z; xy, yz, 3z² − 1, xz, x² − y². This function multiplies each coefficient by the constant that normalises
    its harmonic.
    """
    constants = (BANDS[0], *[BANDS[1]] * 3, *THIRD)
    for number, (rgb, constant) in enumerate(zip(harmonics, constants, strict=True)):
        for socket, value in zip(tree.nodes[_term(number)].inputs, rgb, strict=True):
            socket.default_value = value * constant
    _set_window(tree)


def set_rotation(tree: bpy.types.ShaderNodeTree, rotation: Sequence[float]) -> None:
    """Set the rotation of the world's light (Euler angles) in the node group `tree`. Changes nothing if it is set already."""
    socket = _rotation(tree).inputs["Rotation"]
    if any(abs(old - new) > 1e-6 for old, new in zip(socket.default_value, rotation, strict=True)):
        socket.default_value = rotation
        _set_window(tree)


def _rotation(tree: bpy.types.ShaderNodeTree) -> bpy.types.Node:
    """Return the node ROTATION. It is inserted if it is missing: in a new group, and in those of files saved without it."""
    if ROTATION not in tree.nodes:
        normal = next(node for node in tree.nodes if node.type == "SEPXYZ").inputs[0]
        # Of the same kind as the world's own node, so that it turns in the same way.
        node = add(tree, "ShaderNodeMapping", {"Vector": normal.links[0].from_socket}, name=ROTATION)
        node.vector_type = "TEXTURE"
        tree.links.new(out(node), normal)
    return tree.nodes[ROTATION]


def _set_window(tree: bpy.types.ShaderNodeTree) -> None:
    """Compute the factor by which Eevee weakens the world's harmonics of degree 1, from the light and rotation in the group `tree`.

    For diffuse light, Eevee uses only the harmonics of degree 0 and 1. It multiplies the coefficients of degree 1 by the factor. The factor
    is 1 if they are within a limit. Otherwise it is the largest one that brings red, green and blue within the limit. Let c be the
    coefficient of degree 0 of the radiance in one of these colours, and v the vector of the three coefficients of degree 1.
    - Until Blender 5.0, no component of v may exceed c / √3.
    - From 5.1 on, the length of v may not exceed 0.75 · c.

    On spheres in 4.3, 4.5, 5.0, 5.1, 5.2 and 5.3, under five panoramas each, the computed factor was right to 0.02.
    """
    turn = Euler(_rotation(tree).inputs["Rotation"].default_value).to_matrix()
    terms = [[socket.default_value for socket in tree.nodes[_term(number)].inputs] for number in range(4)]
    factor = 1.0
    for constant, *line in zip(*terms, strict=True):
        v = turn @ Vector(line) / (LOBE[1] * BANDS[1])
        if EEVEE_WINDOW_BY_LENGTH:
            allowed, needed = 0.75 * constant / BANDS[0], v.length
        else:
            allowed, needed = constant / BANDS[1], max(map(abs, v))
        factor = min(factor, allowed / max(needed, 1e-12))
    tree.nodes[_WINDOW].outputs[0].default_value = factor


def add_world_diffuse(material: bpy.types.Material, occlusion: bpy.types.NodeSocket | None = None) -> None:
    """Insert the group `RefGS World Diffuse` before the base colour of a material's Principled BSDF."""
    tree, shader = material.node_tree, principled(material)
    node = add(tree, "ShaderNodeGroup", name=NAME, node_tree=world_diffuse_group())
    for name in ("Base Color", "Metallic", "Normal"):
        socket = shader.inputs[name]
        if socket.links:
            tree.links.new(socket.links[0].from_socket, node.inputs[name])
        elif name == "Normal":
            tree.links.new(add(tree, "ShaderNodeNewGeometry").outputs["Normal"], node.inputs[name])
        else:
            node.inputs[name].default_value = socket.default_value
    if occlusion is not None:
        tree.links.new(occlusion, node.inputs["Occlusion"])
    tree.links.new(node.outputs[0], shader.inputs["Base Color"])


def surface_inputs(material: bpy.types.Material) -> dict[str, list[bpy.types.NodeSocket]]:
    """Find the sockets that take a material's base colour, metallic and roughness.

    Returns {name: sockets} with the names of the Principled BSDF's inputs, such as "Base Color". Each list has that input of the BSDF. If
    the material has the group `RefGS World Diffuse`, two lists differ:
    - The list "Base Color" has the group's input instead.
    - The list "Metallic" has the group's input, too, after the BSDF's.
    """
    shader, node = principled(material), material.node_tree.nodes.get(NAME)
    found = {name: [shader.inputs[name]] for name in ("Base Color", "Metallic", "Roughness")}
    if node is not None:
        found["Base Color"] = [node.inputs["Base Color"]]
        found["Metallic"].append(node.inputs["Metallic"])
    return found
