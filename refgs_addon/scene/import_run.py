"""Import a run folder, the result of a training: its splats, mesh and cameras, and the light recovered from the photos."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import bpy
from mathutils import Matrix

from .. import jobs
from ..errors import InputError
from ..json_file import read_json
from ..nodes import principled
from ..nodes.world_diffuse import add_world_diffuse
from ..ordinary import check_gltf
from . import run_parts
from .camera_objects import add_camera, frame_camera, light_of, read_cameras
from .capture_cameras import replace_cameras
from .color_spaces import LINEAR_REC709, SRGB, set_color_space
from .place_run import extent
from .run_toml import capture_of
from .splat_cloud import add_splats, cloud_attributes, is_ours, normal_slopes, point_cloud, read_constants, read_splats
from .world_light import correct_diffuse, keep_world, light_with_recovered, load_panorama

THEIRS = (".ply", ".spz")  # files of splats by other programs
LAYERS = 64  # transparent quads that a ray passes in Cycles: 16 left splats a tenth too dark and blotched, 256 showed no more
DEPTH = 0.005  # of a mesh under the splats, as a part of the run's longest side


@dataclass
class Run:
    """Hold the objects that `import_run` made, None or empty if the run lacks them."""

    collection: bpy.types.Collection
    root: bpy.types.Object
    """Empty that moves, rotates and scales all other objects."""
    splats: bpy.types.Object
    left_out: int
    """Number of splats left out for values that are not finite."""
    mesh: list[bpy.types.Object] = field(default_factory=list)
    world: bpy.types.World | None = None
    cameras: dict[str, bpy.types.Object] = field(default_factory=dict)
    """Cameras by view, the photo's name without its extension."""
    light_of: str = ""
    """View that the world belongs to, if the light turned with the camera. Also in the world's property `refgs_light_of`."""
    light_is_rec709: bool = True
    """False if the OpenColorIO config has no linear Rec.709 that is known: then the world's colours are those of another space."""


def import_run(folder: Path, scene: bpy.types.Scene) -> Run:
    """Import a run folder, the result of a training, into a scene, as a new collection `RefGS NAME`.

    In the folder, splats.ply must exist. mesh.glb, environment.exr and cameras.json may be missing. The light becomes the scene's world,
    and the file keeps the old world; the panorama is packed into it. If there is a mesh, it is shown and the splats are hidden: Blender
    shades each splat by itself, which looks grainy on polished surfaces. `run_parts.show` switches between the two. The cameras are hidden.
    An Empty is the parent of all objects. `trace_rays` sets up Eevee and Cycles. If `capture_cameras.show_cameras` added the cameras of the
    same capture, the run's cameras replace them. If this function raises InputError, it leaves the open file unchanged.

    In the folder's place may be a file of splats, .ply or .spz. Splats of other programs have no materials and become matte. Their normals
    are their shortest axes, which may point to either side, and are turned to the viewer.
    """
    folder, file = _run_and_splats(Path(folder))
    name = folder.stem if folder == file else folder.name
    capture = capture_of(folder)
    frames = read_cameras(folder / "cameras.json", capture) if (folder / "cameras.json").exists() else []
    before, world, camera = data_blocks(), scene.world, scene.camera
    try:
        run = _add_splats_and_mesh(folder, file, scene, name)
        if (folder / "environment.exr").exists():
            _light_with_own(run, folder, scene, name)
        if frames:
            _add_cameras(run, frames, scene, name)
        for item in (run.splats, *run.mesh):
            item.parent, item.matrix_parent_inverse = run.root, Matrix.Translation(-run.root.location)
        for material in {material for item in (run.splats, *run.mesh) for material in item.data.materials}:
            add_world_diffuse(material, _occlusion(material))
        correct_diffuse(scene)
        solid = [item for item in run.mesh if item.data.polygons]
        if solid:
            put_under(solid, run.splats)
        run_parts.show(run.collection, "mesh" if solid else "splats")
    except BaseException:
        scene.world, scene.camera = world, camera
        bpy.data.batch_remove(data_blocks() - before)
        raise
    if scene.world != world:
        keep_world(world)
    trace_rays(scene)
    if capture is not None and frames:
        replace_cameras(scene, capture, run.cameras)
    return run


def _run_and_splats(folder: Path) -> tuple[Path, Path]:
    """Return the absolute paths of a run folder and its splats.ply. Of a file of splats, both are the file's. Raises InputError."""
    # Not resolved: by a link's target, a copied project would find the original's run.
    absolute = Path(os.path.abspath(folder))
    if folder.suffix.lower() in THEIRS and folder.is_file():
        return absolute, absolute
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: choose the folder that a training wrote")
    if not os.path.lexists(folder / "splats.ply"):
        if jobs.run_state(folder):
            raise InputError(f"the training of {folder} has not ended: wait for it, or resume it")
        raise InputError(f"{folder} is not a run: it has no splats.ply. Choose the folder that a training wrote")
    return absolute, absolute / "splats.ply"


def _add_splats_and_mesh(folder: Path, file: Path, scene: bpy.types.Scene, name: str) -> Run:
    """Add a collection with a run's splats, which are in `file`, its mesh and the Empty that will move them."""
    splats, left_out = read_splats(file)
    theirs = not is_ours(file)
    collection = bpy.data.collections.new(f"RefGS {name}")
    if file != folder:
        collection[run_parts.FOLDER] = str(folder)
    if theirs:
        collection[run_parts.THEIRS] = True
    if words := _doubt_words(folder):
        collection[run_parts.DOUBT] = words
    scene.collection.children.link(collection)
    cloud = point_cloud(f"{name} splats", cloud_attributes(splats, *normal_slopes(splats)))
    drawn = add_splats(cloud.name, cloud, collection, {} if theirs else read_constants(file), theirs)
    drawn[run_parts.KEY] = "splats"
    mesh = add_mesh(folder / "mesh.glb", f"{name} mesh", collection) if (folder / "mesh.glb").exists() else []
    return Run(collection, add_root(f"RefGS {name}", drawn, mesh), drawn, left_out, mesh)


def _light_with_own(run: Run, folder: Path, scene: bpy.types.Scene, name: str) -> None:
    """Light the scene with the panorama that was recovered from the run's photos."""
    light = load_panorama(folder / "environment.exr")
    run.light_is_rec709 = set_color_space(light, LINEAR_REC709)
    light.pack()  # the .blend keeps it where the run folder is moved or deleted
    run.world = light_with_recovered(scene, f"RefGS {name}", light)
    run.light_of = light_of(folder / "cameras.json") if (folder / "cameras.json").exists() else ""
    if run.light_of:
        run.world["refgs_light_of"] = run.light_of


def _add_cameras(run: Run, frames: list[dict], scene: bpy.types.Scene, name: str) -> None:
    """Add a hidden collection with a run's cameras. The first one becomes the scene's camera if there is none."""
    cameras = bpy.data.collections.new(f"{name} cameras")
    cameras[run_parts.CAMERAS] = cameras.hide_viewport = True  # a hundred cameras hide the object
    run.collection.children.link(cameras)
    run.cameras = {frame["name"]: add_camera(frame, cameras) for frame in frames}
    # Blender draws a dashed line from each camera to its parent, unless that is hidden.
    holder = bpy.data.objects.new(cameras.name, None)
    holder.hide_viewport = True
    holder.parent, holder.matrix_parent_inverse = run.root, Matrix.Translation(-run.root.location)
    cameras.objects.link(holder)
    for camera in run.cameras.values():
        camera.parent = holder
    if scene.camera is None:
        frame_camera(scene, next(iter(run.cameras.values())))


def add_root(name: str, splats: bpy.types.Object, mesh: list[bpy.types.Object]) -> bpy.types.Object:
    """Add the Empty that moves, rotates and scales a run, at its bottom centre."""
    low, high = extent(splats, mesh)
    item = bpy.data.objects.new(name, None)
    item.location = (low.x + high.x) / 2, (low.y + high.y) / 2, low.z
    item[run_parts.ROOT] = max(high - low)
    item.empty_display_size = max(high - low) / 2
    splats.users_collection[0].objects.link(item)
    return item


def put_under(meshes: list[bpy.types.Object], splats: bpy.types.Object) -> None:
    """Let the meshes cast shadows and appear in reflections in place of the splats, while `run_parts.show` shows the splats.

    Each mesh is shrunk a little, because splats inside it would lie in its shadow.
    """
    depth = DEPTH * splats.parent[run_parts.ROOT]
    for item in meshes:
        modifier = item.modifiers.new(run_parts.INSIDE, "DISPLACE")
        # By custom normals, which are equal on both sides of the textures' seams: others would tear the mesh.
        modifier.direction, modifier.mid_level, modifier.strength = "CUSTOM_NORMAL", 0.0, -depth
    for kind in ("diffuse", "glossy", "transmission", "volume_scatter"):
        setattr(splats, f"visible_{kind}", False)


def trace_rays(scene: bpy.types.Scene) -> None:
    """Set up a scene's render engines for a run: ray tracing in Eevee, and at least 64 transparent bounces in Cycles.

    With ray tracing, Eevee also shows the object's reflections and shadows on itself. Rays are traced at full resolution and not denoised,
    because half the resolution and Blender's denoising both make chrome and glossy paint look dull. If ray tracing is already on, its
    options stay.
    """
    if not scene.eevee.use_raytracing:
        scene.eevee.use_raytracing = True
        scene.eevee.ray_tracing_options.resolution_scale = "1"
        scene.eevee.ray_tracing_options.use_denoise = False
    if hasattr(scene, "cycles"):  # its add-on can be off
        scene.cycles.transparent_max_bounces = max(scene.cycles.transparent_max_bounces, LAYERS)


def add_mesh(path: Path, name: str, collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Import a GLB with Blender's importer, and move its meshes into the collection. Returns the mesh objects.

    Vertices that the file doubles at the seams of the textures are merged, so that the mesh is closed. Raises InputError if the file cannot
    be imported or contains no mesh.
    """
    check_gltf(path)
    before, units = set(bpy.data.objects), bpy.context.scene.unit_settings
    # The importer takes the file's units for metres; the splats' are Blender's.
    length, units.scale_length = units.scale_length, 1.0
    try:
        bpy.ops.import_scene.gltf(filepath=str(path), merge_vertices=True)
    except (AttributeError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"Blender's glTF add-on did not import {path}: {reason}") from None
    finally:
        units.scale_length = length
    added = [item for item in bpy.data.objects if item not in before]
    bpy.context.view_layer.update()
    meshes = [item for item in added if item.type == "MESH"]
    for item in meshes:
        # Keep the transforms of the file's nodes, which become empty parents, and drop the parents.
        matrix = item.matrix_world.copy()
        item.parent, item.matrix_world = None, matrix
        for other in item.users_collection:
            other.objects.unlink(item)
        collection.objects.link(item)
        item.name = item.data.name = name
        item[run_parts.KEY] = "mesh"
        for material in item.data.materials:
            for link in principled(material).inputs["Base Color"].links:
                # Blender's importer leaves the config's default for pictures of 8 bits. In a config of ACES 1.3 that is ACEScct.
                if link.from_node.type == "TEX_IMAGE":
                    set_color_space(link.from_node.image, SRGB)
    bpy.data.batch_remove(set(added) - set(meshes))
    if not meshes:
        raise InputError(f"{path} contains no mesh: export the run again")
    return meshes


def _doubt_words(folder: Path) -> str:
    """Read the trainer's sentence on a run's doubt from metrics.json, or "" if none."""
    try:
        return str(read_json(folder / "metrics.json")["doubt"]["what"])
    except (InputError, KeyError, TypeError):  # not there, of an older release, or half copied
        return ""


def _occlusion(material: bpy.types.Material) -> bpy.types.NodeSocket | None:
    """Find the output with the ambient occlusion of an imported glTF material, or None."""
    inputs = (node.inputs.get("Occlusion") for node in material.node_tree.nodes if node.type == "GROUP")
    return next((socket.links[0].from_socket for socket in inputs if socket and socket.links), None)


def data_blocks() -> set[bpy.types.ID]:
    """List all data-blocks in the open file, of the kinds that an import can add."""
    kinds = ("objects", "pointclouds", "meshes", "cameras", "materials", "images", "worlds", "collections")
    kinds += ("node_groups", "scenes")
    return {item for kind in kinds for item in getattr(bpy.data, kind)}
