"""Define the operators that prepare a capture: photos from a video, masks, and strokes that correct masks."""

import contextlib
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ... import compat
from ...ui.operators import ReportsErrors
from ..scene import training
from ..scene.strokes import add_canvas, camera_with_photo
from .on_capture import OnCapture, has_trainer

HARD_BRUSH = "brushes/essentials_brushes-mesh_texture.blend/Brush/Paint Hard"
PAINTS = {
    "object": ("Object", "Paint white: this is the object"),
    "rest": ("Not the Object", "Paint black: this is not the object"),
    "nothing": ("Erase", "Take strokes away"),
}


class PhotosFromVideo(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.photos_from_video"
    bl_label = "Photos from Video…"
    bl_description = (
        "Choose sharp photos from a film around the object, without blurred ones and those that show the same"
    )
    bl_options: ClassVar = {"REGISTER"}

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.mp4;*.mov;*.m4v;*.mkv;*.avi;*.webm", options={"HIDDEN"})
    out: StringProperty(
        name="Folder",
        description="Folder for the photos, which becomes the capture. If left empty, a new one beside the video",
        subtype="DIR_PATH",
    )
    count: IntProperty(
        name="Photos",
        description="Number of photos, less those that are left out",
        default=100,
        min=3,
        max=1000,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls)

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> None:
        out = Path(bpy.path.abspath(self.out)) if self.out else None
        training.extract_photos(context.scene, Path(bpy.path.abspath(self.filepath)), out, self.count)


class MakeMasks(OnCapture, bpy.types.Operator):
    bl_idname = "refgs.make_masks"
    bl_label = "Make Masks"
    bl_description = (
        "Cut the object out of all photos: what the cameras look at, or what is in the Region. Your own masks are kept"
    )

    def work(self, context: bpy.types.Context) -> None:
        training.make_masks(context.scene)


class PaintStrokes(OnCapture, bpy.types.Operator):
    bl_idname = "refgs.paint_strokes"
    bl_label = "Paint Mask"
    bl_description = (
        "Open the photo of the selected camera, to paint a few strokes where its mask is wrong: "
        "white on the object, black on what is not. The mask leaves out what is red"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        cls.poll_message_set("Press Show Cameras and select the camera of a photo first")
        return camera_with_photo(context) is not None

    def work(self, context: bpy.types.Context) -> None:
        capture = Path(bpy.path.abspath(context.scene.refgs.capture))
        show_in_editor(context, add_canvas(capture, camera_with_photo(context)))


class SaveStrokes(OnCapture, bpy.types.Operator):
    bl_idname = "refgs.save_strokes"
    bl_label = "Save Strokes and Update Masks"
    bl_description = "Write the painted strokes to the capture's folder strokes, and make the masks of all photos anew"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        training.save_strokes(context.scene)


class ChooseBrush(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.choose_brush"
    bl_label = "Choose Brush"
    bl_options: ClassVar = {"REGISTER"}

    paints: EnumProperty(
        name="Paints",
        items=[(paints, *words) for paints, words in PAINTS.items()],
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return PAINTS[properties.paints][1]

    def work(self, context: bpy.types.Context) -> None:
        choose_brush(context.tool_settings, self.paints)


def choose_brush(settings: bpy.types.ToolSettings, paints: str) -> None:
    """Set up the brush that paints on images, for the strokes that correct a mask.

    `paints` is "object" (white strokes), "rest" (black strokes, on what is not the object) or "nothing" (erase strokes).
    """
    colors = compat.paint_colors(settings)
    colors.use_unified_color = True
    colors.color, colors.secondary_color = ((0.0,) * 3, (1.0,) * 3) if paints == "rest" else ((1.0,) * 3, (0.0,) * 3)
    brush = settings.image_paint.brush
    if brush is not None:
        brush.blend = "ERASE_ALPHA" if paints == "nothing" else "MIX"
        brush.strength = 1.0


def show_in_editor(context: bpy.types.Context, canvas: bpy.types.Image) -> None:
    """Show a canvas, the image on which strokes are painted, in an image editor in paint mode.

    Opens a new window if there is no image editor. Does nothing if Blender has no window.
    """
    if bpy.app.background:
        return
    manager = context.window_manager
    editors = [
        (window, area) for window in manager.windows for area in window.screen.areas if area.ui_type == "IMAGE_EDITOR"
    ]
    if not editors:
        bpy.ops.wm.window_new()
        window = manager.windows[-1]
        editors = [(window, window.screen.areas[0])]
        editors[0][1].ui_type = "IMAGE_EDITOR"
    window, area = editors[0]
    space = area.spaces.active
    space.image, space.ui_mode, space.show_region_ui = canvas, "PAINT", True
    region = next(region for region in area.regions if region.type == "WINDOW")
    with context.temp_override(window=window, area=area, region=region):
        with contextlib.suppress(RuntimeError):  # some builds of Blender come without its brushes
            bpy.ops.brush.asset_activate(asset_library_type="ESSENTIALS", relative_asset_identifier=HARD_BRUSH)
        bpy.ops.image.view_all(fit_view=True)
    choose_brush(context.scene.tool_settings, "object")
    sidebar = next(region for region in area.regions if region.type == "UI")

    def choose_tab() -> None:
        with contextlib.suppress(ReferenceError, TypeError):  # the window was closed, or its tabs are not drawn yet
            sidebar.active_panel_category = "RefGS"

    bpy.app.timers.register(choose_tab, first_interval=0.5)


CLASSES = (PhotosFromVideo, MakeMasks, PaintStrokes, SaveStrokes, ChooseBrush)
