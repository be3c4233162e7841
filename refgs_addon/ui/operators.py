"""Define the operators of the Run and Preview panels, and the base classes of all operators."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from .. import jobs
from ..errors import InputError, missing_module
from ..preferences import hdri_folder
from ..scene.asset import mark_asset
from ..scene.camera_objects import PHOTO, next_camera, photo_shown, show_photo
from ..scene.capture_cameras import active_cameras
from ..scene.deleted_splats import add_points, restore
from ..scene.detail import set_detail
from ..scene.place_run import put_beside
from ..scene.regions import crop, training_region
from ..scene.render_eevee import render_preview
from ..scene.render_process import render_in_background
from ..scene.run_parts import EXAMPLE, active_run, show, shown
from ..scene.run_toml import capture_of, newer_release, up_was_chosen
from ..scene.turntable import add_turntable
from ..scene.world_light import hdris

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "blender.md"


class ReportsErrors:
    """Call the operator's method `work`, and show an InputError as one line."""

    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.work(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        except ModuleNotFoundError as error:
            self.report({"ERROR"}, missing_module(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class OnJob(ReportsErrors):
    """Give an operator the job that its button was drawn for. Base class of the operators on one job.

    The job is found by its serial number, because its place in the list changes when another job is dismissed.
    """

    bl_options: ClassVar = {"REGISTER"}

    serial: IntProperty(name="Serial", description="Serial number of the job", options={"SKIP_SAVE"})

    @property
    def job(self) -> jobs.Job:
        return jobs.find(self.serial)


class OnRun(ReportsErrors):
    """Disable an operator's button, with the reason, while no run is imported."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a run first")
        return active_run(context) is not None


class OnRunFolder(ReportsErrors):
    """Store the folder of the listed run that an operator works on."""

    folder: StringProperty(name="Run Folder")


def import_run_folder(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path) -> None:
    """Import a run folder, and report the result and its problems to the artist."""
    from ..scene.import_run import import_run

    run = import_run(folder, context.scene)
    beside = put_beside(run.collection, context.view_layer)
    where = f", beside {beside.name}, which was in its place" if beside else ""
    operator.report({"INFO"}, f"Imported {run.collection.name}: {len(run.splats.data.points):,} splats{where}")
    splats = shown(run.collection) == "splats"
    select_only(context, run.splats if splats else run.mesh[0])
    show_materials(context, ("SOLID",))
    frame_selected(context)
    if run.left_out:
        operator.report({"WARNING"}, f"{run.left_out:,} splats with values that are not finite were left out")
    if run.light_of:
        text = f"The light turned with the camera: the world's rotation fits the photo {run.light_of}, and no other"
        operator.report({"WARNING"}, text)
    if not run.light_is_rec709:
        text = "This OpenColorIO config has no linear Rec.709 by a known name: set the recovered light's colour space yourself"
        operator.report({"WARNING"}, text)
    if made_by := newer_release(folder):
        text = f"RefGS {made_by} made this run. This add-on is older and may ignore parts of it: update the add-on"
        operator.report({"WARNING"}, text)
    box = training_region(context.scene)
    chosen = Path(bpy.path.abspath(context.scene.refgs.capture)).resolve()
    if box is not None and up_was_chosen(folder) and capture_of(folder) == chosen:
        box.hide_viewport = True
        text = f"{box.name} was hidden: it is in the frame of the photos' cameras, but the run was rotated upright"
        operator.report({"WARNING"}, text)


class AsksForFolder(ReportsErrors):
    """Ask for the folder that an operator works on, in Blender's file browser."""

    directory: StringProperty(name="Run Folder", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @property
    def chosen_folder(self) -> Path:
        return Path(bpy.path.abspath(self.directory))


class ImportRun(AsksForFolder, bpy.types.Operator):
    bl_idname = "refgs.import_run"
    bl_label = "Import RefGS Run"
    bl_description = "Import a run folder: splats, mesh, recovered light and cameras"

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, self.chosen_folder)


class ImportExample(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.import_example"
    bl_label = "Import Example"
    bl_description = (
        "Import a small run that comes with the add-on, to try edits and lights: a jar of gold, copper and ceramic"
    )

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, EXAMPLE)


class ImportSplats(ReportsErrors, ImportHelper, bpy.types.Operator):
    bl_idname = "refgs.import_splats"
    bl_label = "Import Splats"
    bl_description = "Import Gaussian splats of another program, to light them: matte, with the shortest axis as normal"

    filter_glob: StringProperty(default="*.ply;*.spz", options={"HIDDEN"})

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, Path(bpy.path.abspath(self.filepath)))


class OpenManual(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.open_manual"
    bl_label = "Open Manual"
    bl_description = (
        "Open the manual's page on Blender, a text file that came with the add-on. Its folder has the other pages"
    )
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        if not MANUAL.is_file():
            raise InputError(f"{MANUAL} does not exist: install the add-on again")
        bpy.ops.wm.path_open(filepath=str(MANUAL))


class FindRun(AsksForFolder, OnRunFolder, bpy.types.Operator):
    bl_idname = "refgs.find_run"
    bl_label = "Find Run Folder"
    bl_description = (
        "Choose the folder of this run, if it was moved, renamed or copied: all paths to it follow, and edits stay"
    )

    def work(self, context: bpy.types.Context) -> None:
        from ..scene.find_run import find_run

        old = Path(self.folder)
        find_run(old, self.chosen_folder)
        self.report({"INFO"}, f"{old.name} is in {self.chosen_folder}")


class ShowPart(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.show"
    bl_label = "Show"
    bl_description = "Show the run's splats or its mesh, in the viewport and in renders"

    collection: StringProperty(name="Run", description="The run's collection")
    part: EnumProperty(name="Part", items=[("splats", "Splats", ""), ("mesh", "Mesh", "")])

    def work(self, context: bpy.types.Context) -> None:
        if context.mode == "PAINT_WEIGHT":  # whose colours would cover the part
            bpy.ops.object.mode_set(mode="OBJECT")
        show(bpy.data.collections[self.collection], self.part)
        if self.part == "splats":  # in Solid, they are grey shards, and the mesh covers them
            show_materials(context, ("SOLID",))


class SetDetail(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.set_detail"
    bl_label = "Detail"
    bl_description = "Show all splats and triangles of the run, or a part of them, which is faster and smaller"

    collection: StringProperty(name="Run", description="The run's collection")
    level: FloatProperty(name="Detail", description="Part of the splats and triangles", min=0.01, max=1.0, default=1.0)

    def work(self, context: bpy.types.Context) -> None:
        set_detail(bpy.data.collections[self.collection], self.level)


class Crop(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.crop"
    bl_label = "Crop"
    bl_description = "Draw only the splats in a box that you move, rotate and scale; or all splats again"

    splats: StringProperty(name="Splats", description="The object")
    on: BoolProperty(name="Crop", default=True)

    def work(self, context: bpy.types.Context) -> None:
        splats = bpy.data.objects[self.splats]
        box = crop(splats, splats.users_collection[0], self.on)
        if self.on:
            select_only(context, box)


class _Deletes(ReportsErrors):
    """Find the splats' object for an operator, after a switch to Object Mode."""

    splats: StringProperty(name="Splats", description="The object")

    def found(self, context: bpy.types.Context) -> bpy.types.Object:
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        return bpy.data.objects[self.splats]


class DeleteSplats(_Deletes, bpy.types.Operator):
    bl_idname = "refgs.delete_splats"
    bl_label = "Delete Splats"
    bl_description = "Select splats as points, with lasso, box or any other tool, and delete them with X. Tab ends it"

    def work(self, context: bpy.types.Context) -> None:
        select_only(context, add_points(self.found(context)))
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_mode(type="VERT")
        bpy.ops.mesh.select_all(action="DESELECT")
        if context.space_data is not None:
            bpy.ops.wm.tool_set_by_id(name="builtin.select_lasso")


class RestoreSplats(_Deletes, bpy.types.Operator):
    bl_idname = "refgs.restore_splats"
    bl_label = "Restore Splats"
    bl_description = "Bring all deleted splats back"

    def work(self, context: bpy.types.Context) -> None:
        restore(self.found(context))


def show_materials(context: bpy.types.Context, instead_of: tuple[str, ...] = ("SOLID", "WIREFRAME")) -> None:
    """Switch the 3D views of all windows to Material Preview, lit by the scene's world, if they show one of the shadings `instead_of`."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                shading = area.spaces.active.shading
                if shading.type in instead_of:
                    shading.type, shading.use_scene_world = "MATERIAL", True


def frame_selected(context: bpy.types.Context) -> None:
    """Bring the selected object into view in all 3D views."""
    for area in context.screen.areas if context.screen else ():
        if area.type == "VIEW_3D":
            region = next(region for region in area.regions if region.type == "WINDOW")
            with context.temp_override(area=area, region=region):
                bpy.ops.view3d.view_selected()


def select_only(context: bpy.types.Context, item: bpy.types.Object) -> None:
    """Make an object the active one, and deselect all others."""
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item


class NextCamera(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.next_camera"
    bl_label = "Next Camera"
    bl_description = "Look through the next or previous camera of the photos"

    steps: IntProperty(name="Steps", default=1)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a run, or show the cameras of a checked capture first")
        return active_cameras(context) is not None

    def work(self, context: bpy.types.Context) -> None:
        next_camera(context.scene, active_cameras(context), self.steps)
        view_through_camera(context)


class Photo(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.photo"
    bl_label = "Photo"
    bl_description = "Lay the camera's photo over the view for comparison, or remove it"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("The scene's camera has no photo: choose one of an imported run or of a checked capture")
        camera = context.scene.camera
        return camera is not None and camera.type == "CAMERA" and bool(camera.data.get(PHOTO))

    def work(self, context: bpy.types.Context) -> None:
        camera = context.scene.camera
        show_photo(camera, 0.0 if photo_shown(camera) else 1.0)
        view_through_camera(context)


def view_through_camera(context: bpy.types.Context) -> None:
    """Make the 3D view in which the button was pressed look through the scene's camera."""
    if context.region_data is not None:
        context.region_data.view_perspective = "CAMERA"


class Turntable(OnRun, bpy.types.Operator):
    bl_idname = "refgs.turntable"
    bl_label = "Turntable"
    bl_description = (
        "Rotate the object once about itself within the scene's frame range; Render > Render Animation renders the film"
    )

    def work(self, context: bpy.types.Context) -> None:
        add_turntable(context.scene, active_run(context))


class MarkAsset(OnRun, bpy.types.Operator):
    bl_idname = "refgs.mark_asset"
    bl_label = "Mark as Asset"
    bl_description = "Show the run in the asset browser, by a picture from the scene's camera"

    def work(self, context: bpy.types.Context) -> None:
        mark_asset(context.scene, active_run(context))


class _Render(ReportsErrors, ExportHelper):
    """Ask for a PNG file to render to, and require a camera in the scene."""

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
    bl_description = "Render the scene camera's view in Eevee to a PNG with a transparent background, in the background"

    size: IntProperty(name="Size", description="Longer side in pixels; 0 takes the photo's", default=0, min=0, max=8192)

    def work(self, context: bpy.types.Context) -> None:
        png, size = Path(bpy.path.abspath(self.filepath)), self.size or None
        if bpy.app.background:
            render_preview(context.scene, png, size=size, samples=self.samples)
        else:
            render_in_background(context.scene, png, size=size, samples=self.samples)


class ContactSheet(_Render, bpy.types.Operator):
    bl_idname = "refgs.contact_sheet"
    bl_label = "Contact Sheet"
    bl_description = "Render the view under the recovered light and all listed HDRIs, side by side in one PNG"

    size: IntProperty(name="Size", description="Longer side of each picture in pixels", default=256, min=16, max=2048)

    def work(self, context: bpy.types.Context) -> None:
        png, lights = Path(bpy.path.abspath(self.filepath)), hdris(hdri_folder())
        if bpy.app.background:
            from ..scene.contact_sheet import contact_sheet

            contact_sheet(context.scene, png, lights, self.size, self.samples)
        else:
            render_in_background(context.scene, png, lights, self.size, self.samples)


class Dismiss(OnJob, bpy.types.Operator):
    bl_idname = "refgs.put_away"
    bl_label = "Dismiss"
    bl_description = "Stop this job if it still runs; remove it from the list if it has ended"

    def work(self, context: bpy.types.Context) -> None:
        if self.job.ended:
            jobs.JOBS.remove(self.job)
        else:
            self.job.stop()


CLASSES = (
    ImportRun,
    ImportExample,
    ImportSplats,
    OpenManual,
    FindRun,
    ShowPart,
    SetDetail,
    Crop,
    DeleteSplats,
    RestoreSplats,
    NextCamera,
    Photo,
    Turntable,
)
CLASSES += (RenderPreview, ContactSheet, Dismiss, MarkAsset)
