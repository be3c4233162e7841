"""Show the cameras of a capture (a folder with photos) in the scene, before its training."""

from pathlib import Path

import bpy

from .camera_objects import PHOTO, add_camera, frame_camera, read_cameras
from .run_parts import active_run

CAPTURE = "refgs_capture"  # custom property of a collection of cameras: the capture's folder


def show_cameras(scene: bpy.types.Scene, capture: Path, cameras: Path) -> bpy.types.Collection:
    """Add the cameras of a capture (a folder with photos) to a scene, in a new collection `NAME cameras`.

    An earlier collection of the same capture is replaced. `cameras` is the path of cameras.json. Raises InputError if that file cannot be
    read.
    """
    frames = read_cameras(cameras, capture)
    remove_cameras(scene, capture)
    collection = bpy.data.collections.new(f"{capture.name} cameras")
    collection[CAPTURE] = str(capture)
    scene.collection.children.link(collection)
    added = [add_camera(frame, collection) for frame in frames]
    if scene.camera is None and added:
        frame_camera(scene, added[0])
    return collection


def cameras_of(scene: bpy.types.Scene, capture: Path) -> bpy.types.Collection | None:
    """Find the collection of cameras that `show_cameras` added for a capture, or return None."""
    return next((item for item in _captures(scene) if item[CAPTURE] == str(capture)), None)


def remove_cameras(scene: bpy.types.Scene, capture: Path) -> None:
    """Remove a capture's cameras from a scene. Does nothing where there are none."""
    collection = cameras_of(scene, capture)
    if collection is not None:
        cameras = [item for item in collection.all_objects if item.type == "CAMERA" and PHOTO in item.data]
        for item in (
            set(collection.objects) - set(cameras) - set(scene.collection.objects)
        ):  # objects that the artist put there
            scene.collection.objects.link(item)
        for child in set(collection.children) - set(scene.collection.children):
            scene.collection.children.link(child)
        bpy.data.batch_remove([*cameras, *(camera.data for camera in cameras), collection])


def replace_cameras(scene: bpy.types.Scene, capture: Path, cameras: dict[str, bpy.types.Object]) -> None:
    """Replace the cameras that `show_cameras` added for a capture by the cameras of an imported run.

    `cameras` has the run's camera objects by name. The capture's cameras are removed, and the run's cameras get these names. If the scene
    looked through a removed camera, it looks through the run's camera of the same photo instead. Does nothing if `show_cameras` added no
    cameras for the capture.
    """
    known = cameras_of(scene, capture)
    if known is None:
        return
    photo = scene.camera.data.get(PHOTO) if scene.camera and scene.camera.name in known.all_objects else None
    remove_cameras(scene, capture)
    for name, camera in cameras.items():
        camera.name = camera.data.name = name
    if photo is not None and cameras:
        of_photo = [camera for camera in cameras.values() if camera.data[PHOTO] == photo]
        frame_camera(scene, (of_photo or list(cameras.values()))[0])


def active_cameras(context: bpy.types.Context) -> bpy.types.Collection | None:
    """Find the collection with the cameras for the buttons "next camera" and "previous camera".

    It is the collection of a run or of a capture: the first that exists in this order.
    1. The collection with the active object.
    2. The newest run or a capture, if the scene's camera is in it.
    3. The newest run.
    4. The newest capture.

    Returns None if there is no run and no capture.
    """
    captures = _captures(context.scene)
    for item in (context.view_layer.objects.active, context.scene.camera):
        for collection in context.scene.collection.children:
            known = collection in captures or collection == active_run(context)
            if item is not None and known and item.name in collection.all_objects:
                return collection
    return active_run(context) or (captures or [None])[-1]


def _captures(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    return [collection for collection in scene.collection.children if CAPTURE in collection]
