"""Make camera objects from cameras.json, look through them, and lay photos over their views."""

import math
from pathlib import Path

import bpy
from mathutils import Matrix

from ..errors import InputError
from ..json_file import read_json
from ..ordinary import check_file

LARGEST = 1e6  # pixels of a photo or of a focal length; Blender stores single-precision numbers
SENSOR_WIDTH = 36.0  # mm, Blender's default
# custom properties of a camera's data: the files of its photo, and of the photo's mask
PHOTO, MASK = "refgs_photo", "refgs_mask"
STROKES = (
    "refgs_strokes"  # custom property of an image, a canvas for strokes that correct a mask: the file of its strokes
)


def read_cameras(path: Path, capture: Path | None) -> list[dict]:
    """Read the cameras of a cameras.json. Returns one dictionary for each photo.

    Each dictionary has `transform_matrix` (4 × 4, camera to world, OpenGL's axes) and the pinhole intrinsics `fl_x`, `fl_y`, `cx`, `cy`,
    `w` and `h` in pixels. `name` is the name of the view. `photo` and `mask` are the paths of the photo and of its mask in the folder
    `capture`, or "" if there is none or `capture` is None. Raises InputError if the file cannot be read, or RefGS did not write it.
    """
    data = read_json(path)
    try:
        frames = data["frames"]
        for frame in frames:
            matrix = Matrix(frame["transform_matrix"])
            numbers = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
            if len(matrix) != 4 or not all(map(math.isfinite, [*numbers, *(x for row in matrix for x in row)])):
                raise ValueError
            if (
                not all(0 < frame[key] < LARGEST for key in ("fl_x", "fl_y", "w", "h"))
                or min(frame["w"], frame["h"]) < 1
            ):
                raise ValueError
            frame["name"] = str.rpartition(frame["file_path"], "/")[2]  # a dot is a part of it
            for key in ("photo", "mask"):
                frame[key] = str(capture / frame[key]) if capture and key in frame else ""
    except (ValueError, KeyError, TypeError, OverflowError):
        raise InputError(f"{path} is not the cameras.json of a RefGS run: export the run again") from None
    return frames


def light_of(path: Path) -> str:
    """Read the name of the view that the recovered light belongs to. Returns "" if the light is right for all views.

    `path` is the file cameras.json. If the light turned with the camera, it had another rotation in each photo. The run's panorama is then
    right only for the named view.
    """
    found = read_json(path)
    name = found.get("light_of", "") if isinstance(found, dict) else ""
    return name.rpartition("/")[2] if isinstance(name, str) else ""


def add_camera(frame: dict, collection: bpy.types.Collection) -> bpy.types.Object:
    """Add a camera object to a collection, with the pose, focal length and principal point of a `frame` of `read_cameras`.

    Blender stores one resolution and one pixel aspect for the whole scene. The values for this photo are stored in the camera's data, as
    the custom properties `refgs_size` (pixels) and `refgs_pixel_aspect`. `frame_camera` sets the scene to them.
    """
    data = bpy.data.cameras.new(frame["name"])
    width, height = frame["w"], frame["h"]
    aspect = frame["fl_x"] / frame["fl_y"]  # a pixel's height over its width
    data.display_size = 0.15  # a hundred cameras of the default size hide the object
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_WIDTH
    data.lens = SENSOR_WIDTH * frame["fl_x"] / width
    # A shift is in picture widths, to the right and up; cx and cy run right and down.
    data.shift_x = 0.5 - frame["cx"] / width
    data.shift_y = (frame["cy"] - 0.5 * height) * aspect / width
    data["refgs_size"] = [int(width), int(height)]
    data["refgs_pixel_aspect"] = [max(1.0, 1.0 / aspect), max(1.0, aspect)]
    data[PHOTO], data[MASK] = frame.get("photo", ""), frame.get("mask", "")
    camera = bpy.data.objects.new(frame["name"], data)
    camera.matrix_world = Matrix(frame["transform_matrix"])
    collection.objects.link(camera)
    return camera


def frame_camera(scene: bpy.types.Scene, camera: bpy.types.Object, size: int | None = None) -> None:
    """Make a camera the scene's camera, and set the render resolution to the size of the camera's photo.

    With `size`, the resolution is scaled so that its longer side is `size` pixels.
    """
    scene.camera = camera
    render = scene.render
    if "refgs_size" in camera.data:
        render.resolution_x, render.resolution_y = camera.data["refgs_size"]
        render.pixel_aspect_x, render.pixel_aspect_y = camera.data["refgs_pixel_aspect"]
    if size:
        longer = max(render.resolution_x, render.resolution_y)
        render.resolution_x = max(1, round(render.resolution_x * size / longer))
        render.resolution_y = max(1, round(render.resolution_y * size / longer))
    render.resolution_percentage = 100


def show_photo(camera: bpy.types.Object, amount: float = 1.0) -> None:
    """Lay a camera's photo over its view with the opacity `amount`; 0 hides the photo. The first call loads the photo.

    Blender draws a photo only if its camera is visible, and the collection of a run's cameras is hidden. So the camera is also linked to
    the scene's own collection while its photo is shown.

    Raises InputError where the camera has no photo, or the photo's file is missing.
    """
    data = camera.data
    if amount > 0 and not data.background_images:
        path = Path(data.get(PHOTO, ""))
        if not data.get(PHOTO):
            raise InputError(f"{camera.name} has no photo: choose a camera of an imported run or of a checked capture")
        try:
            check_file(path)
            image = bpy.data.images.load(str(path), check_existing=True)
        except (OSError, RuntimeError):
            raise InputError(f"the photo {path} does not exist: move the capture back to where it was") from None
        layer = data.background_images.new()
        layer.image, layer.display_depth, layer.frame_method = image, "FRONT", "STRETCH"
    data.show_background_images = amount > 0
    if amount > 0:
        data.background_images[0].alpha = amount
    for scene in camera.users_scene:
        own = scene.collection.objects
        if amount > 0:
            camera.hide_viewport = False
            if camera.name not in own:
                own.link(camera)
            for layer in scene.view_layers:
                camera.hide_set(False, view_layer=layer)
        elif camera.name in own and len(camera.users_collection) > 1:
            own.unlink(camera)


def photo_shown(camera: bpy.types.Object | None) -> float:
    """Return the opacity of the photo over a camera's view, 0 where none is shown."""
    layers = camera.data.background_images if camera is not None and camera.type == "CAMERA" else ()
    return layers[0].alpha if layers and camera.data.show_background_images else 0.0


def next_camera(scene: bpy.types.Scene, collection: bpy.types.Collection, steps: int = 1) -> bpy.types.Object:
    """Switch the scene to the camera that is `steps` places after the present one in a collection, and return that camera.

    After the last camera comes the first. If the old camera shows its photo, the new camera shows its own photo. Raises InputError if the
    collection has no cameras.
    """
    cameras = [item for item in collection.all_objects if item.type == "CAMERA"]
    if not cameras:
        raise InputError(f"{collection.name} has no cameras: its run folder has no cameras.json")
    known = scene.camera in cameras
    camera = cameras[(cameras.index(scene.camera) + steps) % len(cameras)] if known else cameras[0]
    if amount := photo_shown(scene.camera):
        show_photo(scene.camera, 0.0)
        show_photo(camera, amount)
    frame_camera(scene, camera)
    return camera
