"""Draw a checked capture (a folder of photos) in the Train panel: some of its photos, and a button that shows its cameras."""

from pathlib import Path
from typing import ClassVar

import bpy

from ... import jobs
from ...scene.capture_cameras import cameras_of, remove_cameras, show_cameras
from ...ui.icons import thumbnail
from ...ui.operators import OnJob, select_only
from ..scene.training_box import remove_guessed_region, show_guessed_region


class ShowCameras(OnJob, bpy.types.Operator):
    bl_idname = "refgs.show_cameras"
    bl_label = "Show Cameras"
    bl_description = (
        "Add the capture's cameras to the scene to check them, or remove them again. Without masks, "
        "the box in which the object will be looked for is shown: move it if it is not about the object"
    )
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def work(self, context: bpy.types.Context) -> None:
        checked = self.job.results["check"]
        capture = Path(checked["capture"])
        if cameras_of(context.scene, capture):
            remove_cameras(context.scene, capture)
            remove_guessed_region(context.scene)
        else:
            cameras = show_cameras(context.scene, capture, Path(checked["cameras"])).objects
            if cameras:
                select_only(context, cameras[0])
            if "Masks: none" in checked["lines"]:
                show_guessed_region(context.scene, checked["centre"], checked["radius"])


def draw_capture(box: bpy.types.UILayout, scene: bpy.types.Scene, job: jobs.Job) -> None:
    """Draw some photos of a checked capture, and a button that shows its cameras in the scene.

    Draws nothing unless `job` has checked a capture (a folder of photos), as `jobs.check` and `jobs.make_masks` do.
    """
    checked = job.results.get("check", {})
    if "cameras" not in checked:
        return
    grid = box.grid_flow(row_major=True, columns=4, even_columns=True, even_rows=True, align=True)
    for file in checked["thumbnails"]:
        grid.template_icon(icon_value=thumbnail(Path(file), job.serial), scale=3)
    shown = cameras_of(scene, Path(checked["capture"])) is not None
    box.operator(ShowCameras.bl_idname, icon="OUTLINER_OB_CAMERA", depress=shown).serial = job.serial


CLASSES = (ShowCameras,)
