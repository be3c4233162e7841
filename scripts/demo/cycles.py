"""Render one object with Blender's Cycles, lit by a panorama, one view at a time."""

import tempfile
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from mathutils import Matrix

from scripts.demo.shapes import Material, Mesh

FIELD_OF_VIEW = np.radians(40.0)
# Passes that are rendered with the picture, by the same camera rays. Each is the mean over the covered part of a pixel.
VECTORS, SCALARS = ("normal", "albedo"), ("roughness", "metallic", "depth")
INPUTS = {
    "base_color": ("Base Color", "albedo"),
    "metallic": ("Metallic", "metallic"),
    "roughness": ("Roughness", "roughness"),
    "brushed": ("Anisotropic", None),
}
"""A material's values: the Principled BSDF's input and the pass of each."""


def let_light_leave(scene: bpy.types.Scene) -> None:
    """Let Cycles follow light until it has left hollows. By its default of 4 reflections, the inside of a mirrored goblet is black."""
    cycles = scene.cycles
    cycles.max_bounces = cycles.glossy_bounces = cycles.diffuse_bounces = 64  # most paths end by themselves


class Renderer:
    """Render one object in square pictures of `size` pixels, with a field of view of 40°. Replaces Blender's current file.

    The settings make pictures comparable: a box filter one pixel wide (a pixel is the mean over its own square), the same number of
    `samples` in every pixel, and no clamping of bright paths. Intel's denoiser removes the noise that is left.
    """

    def __init__(self, mesh: Mesh, materials: tuple[Material, ...], size: int, samples: int):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = scene = bpy.context.scene
        self.add(mesh, materials)
        self._camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        self._camera.data.angle = FIELD_OF_VIEW
        scene.collection.objects.link(self._camera)
        scene.camera = self._camera
        scene.world = bpy.data.worlds.new("World")
        scene.world.use_nodes = True
        # `visibility` mirrors a white world without lamps to sample.
        self._white = bpy.data.worlds.new("White")
        self._white.use_nodes = True
        self._white.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        self._white.cycles.sampling_method = "NONE"
        self._mirror = _mirror()
        nodes = scene.world.node_tree.nodes
        self._panorama = nodes.new("ShaderNodeTexEnvironment")
        scene.world.node_tree.links.new(self._panorama.outputs["Color"], nodes["Background"].inputs["Color"])

        scene.render.engine = "CYCLES"
        scene.render.resolution_x = scene.render.resolution_y = size
        scene.render.film_transparent = True
        scene.render.use_persistent_data = True
        cycles = scene.cycles
        cycles.device = "CPU"
        cycles.samples = samples
        cycles.use_adaptive_sampling = False
        cycles.pixel_filter_type = "BOX"
        cycles.sample_clamp_indirect = cycles.sample_clamp_direct = 0.0
        cycles.blur_glossy = 0.0
        let_light_leave(scene)
        cycles.use_light_tree = False  # one panorama and no lamps
        cycles.use_denoising = True
        cycles.denoiser = "OPENIMAGEDENOISE"
        # With 16 samples the jar is 38 to 39 dB from the converged picture; "ACCURATE" gives one more for half as much
        # time again.
        cycles.denoising_prefilter = "FAST"
        cycles.denoising_use_gpu = False
        layer = scene.view_layers[0]
        for name in VECTORS + SCALARS:
            aov = layer.aovs.add()
            aov.name, aov.type = name, "COLOR" if name in VECTORS else "VALUE"
        if hasattr(scene.render.image_settings, "media_type"):  # from Blender 5.0
            scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        scene.render.image_settings.color_depth = "32"

    def set_light(self, path: Path) -> None:
        """Light the object by the panorama in an EXR file: linear, in Blender's orientation."""
        self._panorama.image = bpy.data.images.load(str(path))

    def render(self, camera_to_world: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Render one view from a camera-to-world matrix with OpenGL's axes. Returns arrays by name:

        color (h, w, 4): linear, premultiplied; alpha (h, w); normal (h, w, 3): world space, unit length; albedo
        (h, w, 3): base colour; roughness, metallic, depth (h, w): depth along the camera's axis. All are zero where
        alpha is zero.
        """
        return _passes(self._channels(camera_to_world, seed))

    def visibility(self, camera_to_world: np.ndarray, seed: int) -> np.ndarray:
        """Render visibility (h, w): the fraction of a pixel's mirrored rays that do not hit the object again.

        For this, the object is rendered as a perfect mirror in a white world: where it reflects itself, it is black. In a partly covered
        pixel only the covered part counts. Visibility is zero where alpha is zero.
        """
        scene, layer, world = self.scene, self.scene.view_layers[0], self.scene.world
        layer.material_override, scene.world = self._mirror, self._white
        scene.cycles.max_bounces, bounces = 0, scene.cycles.max_bounces
        scene.cycles.use_denoising = False
        try:
            channels = self._channels(camera_to_world, seed)
        finally:
            layer.material_override, scene.world = None, world
            scene.cycles.max_bounces = bounces
            scene.cycles.use_denoising = True
        alpha = channels["ViewLayer.Combined.A"]
        return (channels["ViewLayer.Combined.R"] / np.where(alpha > 0, alpha, 1)).clip(0, 1)

    def _channels(self, camera_to_world: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Render one view. Return the channels of Cycles' multilayer EXR file by name, (h, w) float32 each."""
        self._camera.matrix_world = Matrix(camera_to_world.tolist())  # without Matrix, rows would be read as columns
        self.scene.cycles.seed = seed
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "view.exr")
            self.scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True)
            # A single part; from Blender 5.0, one part for each pass.
            parts = OpenEXR.File(str(path), separate_channels=True).parts
            return {name: channel.pixels for part in parts for name, channel in part.channels.items()}

    def add(self, mesh: Mesh, materials: tuple[Material, ...]) -> bpy.types.Object:
        """Add a mesh to the scene. Return its Blender object."""
        data = bpy.data.meshes.new("Object")
        data.from_pydata(mesh.vertices, [], mesh.triangles)
        data.polygons.foreach_set("material_index", mesh.material.astype(np.int32))
        data.polygons.foreach_set("use_smooth", np.ones(len(mesh.triangles), bool))
        for index, material in enumerate(materials):
            for name in INPUTS:
                if callable(texture := getattr(material, name)):
                    value = np.ones((len(mesh.vertices), 4), np.float32)
                    value[:, :3] = texture(mesh.vertices).reshape(len(value), -1)
                    layer = data.attributes.new(f"{name}{index}", "FLOAT_COLOR", "POINT")
                    layer.data.foreach_set("color", value.ravel())
            data.materials.append(_material(material, index))
        data.update()
        added = bpy.data.objects.new("Object", data)
        self.scene.collection.objects.link(added)
        return added


def _material(values: Material, index: int) -> bpy.types.Material:
    """Make a Principled BSDF with these values. It also writes render passes: albedo, metallic, roughness, normal and depth.

    A texture is read from the mesh's colour attribute that is named after the value and the material's `index`.
    """
    material = bpy.data.materials.new("Material")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]

    def output(name: str):
        node = nodes.new("ShaderNodeOutputAOV")
        node.aov_name = name
        return node.inputs["Color" if name in VECTORS else "Value"]

    for name, (socket, aov) in INPUTS.items():
        value, inputs = getattr(values, name), [shader.inputs[socket], *([output(aov)] if aov else [])]
        if callable(value):
            texture = nodes.new("ShaderNodeAttribute")
            texture.attribute_name = f"{name}{index}"
            for to in inputs:
                links.new(texture.outputs["Color" if to.type == "RGBA" else "Fac"], to)
        else:
            for to in inputs:
                to.default_value = (*value, 1.0) if to.type == "RGBA" else value
    if callable(values.brushed) or values.brushed > 0:
        tangent = nodes.new(
            "ShaderNodeTangent"
        )  # along circles about z; highlights are stretched a quarter turn from there
        tangent.direction_type, tangent.axis = "RADIAL", "Z"
        links.new(tangent.outputs["Tangent"], shader.inputs["Tangent"])
        shader.inputs["Anisotropic Rotation"].default_value = 0.25
    links.new(nodes.new("ShaderNodeNewGeometry").outputs["Normal"], output("normal"))
    links.new(nodes.new("ShaderNodeCameraData").outputs["View Z Depth"], output("depth"))
    return material


def _mirror() -> bpy.types.Material:
    material = bpy.data.materials.new("Mirror")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes.new("ShaderNodeBsdfGlossy")
    shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    shader.inputs["Roughness"].default_value = 0.0
    links.new(shader.outputs["BSDF"], nodes["Material Output"].inputs["Surface"])
    return material


def _passes(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Turn the channels of Cycles' EXR file into one array for each render pass.

    All passes except color and alpha are divided by alpha: when Cycles averages a pixel, a ray that misses the object counts as zero.
    """

    def pick(name: str, letters: str) -> np.ndarray:
        return np.stack([channels[f"ViewLayer.{name}.{letter}"] for letter in letters], -1).astype(np.float32)

    color = pick("Combined", "RGBA")
    alpha = color[..., 3].clip(0, 1)
    seen = alpha > 0
    weight = np.where(seen, 1 / np.where(seen, alpha, 1), 0)
    # The denoiser can reach below zero and beyond the silhouette.
    passes = {"color": np.concatenate([color[..., :3].clip(0) * seen[..., None], alpha[..., None]], -1), "alpha": alpha}
    passes |= {name: pick(name, "RGB") * weight[..., None] for name in VECTORS}
    passes |= {name: pick(name, "X")[..., 0] * weight for name in SCALARS}
    length = np.linalg.norm(passes["normal"], axis=-1, keepdims=True)
    passes["normal"] = passes["normal"] / np.where(length > 0, length, 1)
    return passes
