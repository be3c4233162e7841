"""A whole run: from a run folder to a collection with its splats, mesh, light and cameras."""

from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..errors import InputError
from . import run_parts
from .camera_objects import add_camera, frame_camera, light_of, read_cameras
from .capture_cameras import hand_over
from .run_toml import capture_of
from .splat_cloud import add_splats, normal_slopes, point_cloud, read_constants, read_splats, with_slopes
from .world_light import light_with_recovered, load_panorama


@dataclass
class Run:
    """What was imported; parts that the run folder does not have are None or empty."""

    collection: bpy.types.Collection
    splats: bpy.types.Object
    left_out: int
    """How many splats are not there, for values that are not finite."""
    mesh: list[bpy.types.Object] = field(default_factory=list)
    world: bpy.types.World | None = None
    cameras: dict[str, bpy.types.Object] = field(default_factory=dict)
    """By view: the name of the photo without its ending."""
    light_of: str = ""
    """The view that the world is right for, where the light turned with the camera; the world says so as `refgs_light_of`."""


def import_run(folder: Path, scene: bpy.types.Scene) -> Run:
    """Import a run folder into a scene, in a new collection `RefGS NAME`.

    splats.ply must be there; mesh.glb, environment.exr (which becomes the scene's world) and cameras.json may be
    missing. The mesh is hidden at first, for it is where the splats are: see `run_parts.show`. Cameras that `capture.show_cameras`
    added of the same capture make way for the run's. Raises InputError, and then leaves the file as it was.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: choose the folder that a RefGS run wrote")
    name = folder.resolve().name
    splats, left_out = read_splats(folder / "splats.ply")
    capture = capture_of(folder)
    frames = read_cameras(folder / "cameras.json", capture) if (folder / "cameras.json").exists() else []
    before, world, camera = data_blocks(), scene.world, scene.camera
    try:
        collection = bpy.data.collections.new(f"RefGS {name}")
        collection[run_parts.FOLDER] = str(folder.resolve())
        scene.collection.children.link(collection)
        cloud = point_cloud(f"{name} splats", with_slopes(splats, *normal_slopes(splats)))
        drawn = add_splats(cloud.name, cloud, collection, read_constants(folder / "splats.ply"))
        run = Run(collection, drawn, left_out)
        run.splats[run_parts.KEY] = "splats"
        if (folder / "mesh.glb").exists():
            run.mesh = add_mesh(folder / "mesh.glb", f"{name} mesh", collection)
        if (folder / "environment.exr").exists():
            run.world = light_with_recovered(scene, f"RefGS {name}", load_panorama(folder / "environment.exr"))
            run.light_of = light_of(folder / "cameras.json") if frames else ""
            if run.light_of:
                run.world["refgs_light_of"] = run.light_of
        if frames:
            cameras = bpy.data.collections.new(f"{name} cameras")
            collection.children.link(cameras)
            run.cameras = {frame["name"]: add_camera(frame, cameras) for frame in frames}
            if scene.camera is None:
                frame_camera(scene, next(iter(run.cameras.values())))
        run_parts.show(collection, "splats")
    except BaseException:
        scene.world, scene.camera = world, camera
        bpy.data.batch_remove(data_blocks() - before)
        raise
    if capture is not None and frames:
        hand_over(scene, capture, run.cameras)
    return run


def add_mesh(path: Path, name: str, collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """A GLB through Blender's own importer, moved into the collection."""
    before = set(bpy.data.objects)
    try:
        bpy.ops.import_scene.gltf(filepath=str(path))
    except (AttributeError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"Blender's glTF add-on did not import {path}: {reason}") from None
    added = [item for item in bpy.data.objects if item not in before]
    bpy.context.view_layer.update()
    meshes = [item for item in added if item.type == "MESH"]
    for item in meshes:
        matrix = item.matrix_world.copy()  # the file's own nodes come as empty parents: keep what they did, drop them
        item.parent, item.matrix_world = None, matrix
        for other in item.users_collection:
            other.objects.unlink(item)
        collection.objects.link(item)
        item.name = item.data.name = name
        item[run_parts.KEY] = "mesh"
    bpy.data.batch_remove(set(added) - set(meshes))
    if not meshes:
        raise InputError(f"{path} has no mesh in it: export the run again")
    return meshes


def data_blocks() -> set[bpy.types.ID]:
    """All of the file's data-blocks that an import can add to."""
    kinds = (
        "objects",
        "pointclouds",
        "meshes",
        "cameras",
        "materials",
        "images",
        "worlds",
        "collections",
        "node_groups",
        "scenes",
    )
    return {item for kind in kinds for item in getattr(bpy.data, kind)}
