"""Operators: thin doors from a button to a function of `scene`."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..errors import InputError
from ..preferences import hdri_folder, set_up
from ..scene.camera_objects import PHOTO, next_camera, photo_shown, show_photo
from ..scene.capture_cameras import active_cameras
from ..scene.regions import crop, training_region
from ..scene.render_eevee import render_preview
from ..scene.render_process import render_beside
from ..scene.run_parts import active_run, show
from ..scene.run_toml import capture_of, newer, tilted
from ..scene.turntable import add_turntable
from ..scene.world_light import hdris


class Door:
    """Runs `work`; an InputError becomes one line of report."""

    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.work(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        except ModuleNotFoundError as error:  # Debian's Blender may come without numpy; what imports it, does so late
            name = error.name
            self.report({"ERROR"}, f"Blender's Python lacks {name}: install it (on Debian, python3-{name})")
            return {"CANCELLED"}
        return {"FINISHED"}


def has_run(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether there is a run to work on; the button's tooltip says so where there is none."""
    operator.poll_message_set("Import a run first")
    return active_run(context) is not None


def has_trainer(operator: type[bpy.types.Operator]) -> bool:
    """Whether there is a trainer; the button's tooltip says so where there is none."""
    operator.poll_message_set("Set up the trainer in the add-on's preferences first")
    return set_up()


def import_run_folder(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path) -> None:
    """Import a run, and report what came of it."""
    from ..scene.import_run import import_run

    run = import_run(folder, context.scene)
    operator.report({"INFO"}, f"Imported {run.collection.name}: {len(run.splats.data.points):,} splats")
    if run.left_out:
        operator.report({"WARNING"}, f"{run.left_out:,} splats with numbers that are not finite are left out")
    if run.light_of:
        said = f"The light turned with the camera: the world is as it was for {run.light_of}, and for no other photo"
        operator.report({"WARNING"}, said)
    if made_by := newer(folder):
        said = f"RefGS {made_by} made this run, which is newer than this add-on: what this one does not know of it is missing"
        operator.report({"WARNING"}, said)
    box = training_region(context.scene)
    chosen = Path(bpy.path.abspath(context.scene.refgs.capture)).resolve()
    if box is not None and tilted(folder) and capture_of(folder) == chosen:
        box.hide_viewport = True
        said = f"{box.name}, which stands with the photos' cameras, is hidden: the run stands as the box's Z axis says"
        operator.report({"WARNING"}, said)


class ImportRun(Door, bpy.types.Operator):
    bl_idname = "refgs.import_run"
    bl_label = "Import RefGS Run"
    bl_description = "Import a run folder: splats, mesh, recovered light and cameras"

    directory: StringProperty(name="Run Folder", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, Path(bpy.path.abspath(self.directory)))


class ShowPart(Door, bpy.types.Operator):
    bl_idname = "refgs.show"
    bl_label = "Show"
    bl_description = "Show the run's splats or its mesh, in the viewport and in renders"

    collection: StringProperty(name="Run", description="The run's collection")
    part: EnumProperty(name="Part", items=[("splats", "Splats", ""), ("mesh", "Mesh", "")])

    def work(self, context: bpy.types.Context) -> None:
        show(bpy.data.collections[self.collection], self.part)


class Crop(Door, bpy.types.Operator):
    bl_idname = "refgs.crop"
    bl_label = "Crop"
    bl_description = "Draw only the splats in a box, which you move, turn and scale; or all of them again"

    splats: StringProperty(name="Splats", description="The object")
    on: BoolProperty(name="Crop", default=True)

    def work(self, context: bpy.types.Context) -> None:
        splats = bpy.data.objects[self.splats]
        box = crop(splats, splats.users_collection[0], self.on)
        if self.on:
            choose(context, box)


def choose(context: bpy.types.Context, item: bpy.types.Object) -> None:
    """Make an object the only one that is selected, and the active one."""
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item


class NextCamera(Door, bpy.types.Operator):
    bl_idname = "refgs.next_camera"
    bl_label = "Next Camera"
    bl_description = "Look through another of the photos' cameras"

    steps: IntProperty(name="Steps", default=1)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a run, or show the cameras of a checked capture, first")
        return active_cameras(context) is not None

    def work(self, context: bpy.types.Context) -> None:
        next_camera(context.scene, active_cameras(context), self.steps)
        look_through(context)


class Photo(Door, bpy.types.Operator):
    bl_idname = "refgs.photo"
    bl_label = "Photo"
    bl_description = "Lay the camera's photo over the view, to compare the two, or take it away"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("The scene's camera is none of an imported run or a checked capture")
        return context.scene.camera is not None and PHOTO in context.scene.camera.data

    def work(self, context: bpy.types.Context) -> None:
        camera = context.scene.camera
        show_photo(camera, 0.0 if photo_shown(camera) else 1.0)
        look_through(context)


def look_through(context: bpy.types.Context) -> None:
    """Turn the 3D view that a button is in to the scene's camera."""
    if context.region_data is not None:
        context.region_data.view_perspective = "CAMERA"


class Turntable(Door, bpy.types.Operator):
    bl_idname = "refgs.turntable"
    bl_label = "Turntable"
    bl_description = "Have the object turn once about itself; Render > Render Animation makes the film"

    seconds: FloatProperty(name="Seconds", description="How long a turn takes", default=4.0, min=0.1, soft_max=20.0)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_run(cls, context)

    def work(self, context: bpy.types.Context) -> None:
        add_turntable(context.scene, active_run(context), self.seconds)


class _Render(Door, ExportHelper):
    """Renders in another Blender; where this one has no window, in this one."""

    bl_options: ClassVar = {"REGISTER"}
    filename_ext = ".png"
    filter_glob: StringProperty(default="*.png", options={"HIDDEN"})
    samples: IntProperty(name="Samples", default=64, min=1, max=4096)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("The scene has no camera: import a run, or add one")
        return context.scene.camera is not None


class RenderPreview(_Render, bpy.types.Operator):
    bl_idname = "refgs.render_preview"
    bl_label = "Render Preview"
    bl_description = (
        "Render the scene camera's view in Eevee to a PNG with a transparent background, while Blender stays free"
    )

    size: IntProperty(name="Size", description="Longer side in pixels; 0 keeps the photo's", default=0, min=0, max=8192)

    def work(self, context: bpy.types.Context) -> None:
        png, size = Path(bpy.path.abspath(self.filepath)), self.size or None
        if bpy.app.background:
            render_preview(context.scene, png, size=size, samples=self.samples)
        else:
            render_beside(context.scene, png, size=size, samples=self.samples)


class ContactSheet(_Render, bpy.types.Operator):
    bl_idname = "refgs.contact_sheet"
    bl_label = "Contact Sheet"
    bl_description = "Render the view under the recovered light and all HDRIs at hand, side by side on one PNG"

    size: IntProperty(name="Size", description="Longer side of each in pixels", default=256, min=16, max=2048)

    def work(self, context: bpy.types.Context) -> None:
        png, lights = Path(bpy.path.abspath(self.filepath)), hdris(hdri_folder())
        if bpy.app.background:
            from ..scene.contact_sheet import contact_sheet

            contact_sheet(context.scene, png, lights, self.size, self.samples)
        else:
            render_beside(context.scene, png, lights, self.size, self.samples)


CLASSES = (ImportRun, ShowPart, Crop, NextCamera, Photo, Turntable, RenderPreview, ContactSheet)
