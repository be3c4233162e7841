"""What the Train panel shows of a capture that was checked."""

from pathlib import Path

import bpy
from bpy.props import IntProperty

from .. import jobs
from ..scene.capture_cameras import cameras_of, remove_cameras, show_cameras
from .icons import thumbnail
from .operators import Door, choose


class ShowCameras(Door, bpy.types.Operator):
    bl_idname = "refgs.show_cameras"
    bl_label = "Show Cameras"
    bl_description = "Add the capture's cameras to the scene, to see whether they are right; or remove them again"

    number: IntProperty(name="Number", description="Of the check in the list")

    def work(self, context: bpy.types.Context) -> None:
        checked = jobs.JOBS[self.number].results["check"]
        capture = Path(checked["capture"])
        if cameras_of(context.scene, capture):
            remove_cameras(context.scene, capture)
        else:
            cameras = show_cameras(context.scene, capture, Path(checked["cameras"])).objects
            if cameras:
                choose(context, cameras[0])


def draw_capture(box: bpy.types.UILayout, scene: bpy.types.Scene, number: int, job: jobs.Job) -> None:
    """Some of the photos that a job has checked, and a button for their cameras."""
    checked = job.results.get("check", {})
    if "cameras" not in checked:
        return
    grid = box.grid_flow(row_major=True, columns=4, even_columns=True, even_rows=True, align=True)
    for file in checked["thumbnails"]:
        grid.template_icon(icon_value=thumbnail(Path(file), job.serial), scale=3)
    shown = cameras_of(scene, Path(checked["capture"])) is not None
    box.operator(ShowCameras.bl_idname, icon="OUTLINER_OB_CAMERA", depress=shown).number = number


CLASSES = (ShowCameras,)
