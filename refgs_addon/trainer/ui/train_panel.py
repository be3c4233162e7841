"""Draw the Train panel, and define its operators."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import StringProperty

from ... import jobs
from ...preferences import letters, wrapped_text
from ...scene.regions import training_region
from ...ui.operators import (
    Dismiss,
    FindRun,
    OnJob,
    OnRunFolder,
    OpenManual,
    ReportsErrors,
    import_run_folder,
    select_only,
)
from ...ui.panels import Tab
from .. import preferences
from ..scene import live_splats, training
from ..scene.strokes import canvases, masks_root
from ..scene.training_box import add_training_region
from ..timers import follow_other_processes
from .checked_capture import draw_capture
from .closing import KeepTraining, StopRun
from .decisions_box import draw_decisions
from .job_icons import curve_icon, preview_icon
from .on_capture import OnCapture
from .photo_buttons import MakeMasks, PaintStrokes, PhotosFromVideo, SaveStrokes


class CheckCapture(OnCapture, bpy.types.Operator):
    bl_idname = "refgs.check_capture"
    bl_label = "Check"
    bl_description = "Read all photos and cameras of the capture, and report problems"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        training.check(context.scene)


class FindCameras(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.find_cameras"
    bl_label = "Find Cameras"
    bl_description = "Find the cameras from the photos alone"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        training.find_cameras(context.scene)


class AddTrainingRegion(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.add_training_region"
    bl_label = "Add Region"
    bl_description = (
        "Add a box, or select the existing one: move, rotate and scale it until it contains the object. "
        "Only what is inside is trained. The box's Z axis is the result's up"
    )

    def work(self, context: bpy.types.Context) -> None:
        select_only(context, add_training_region(context.scene))


class Train(OnCapture, bpy.types.Operator):
    bl_idname = "refgs.train"
    bl_label = "Train"
    bl_description = "Learn surfels, materials and light from the photos, in a separate process: Blender stays free"

    def work(self, context: bpy.types.Context) -> None:
        training.train(context.scene)


class Resume(OnRunFolder, bpy.types.Operator):
    bl_idname = "refgs.resume"
    bl_label = "Resume"
    bl_description = "Resume this training from its last checkpoint"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        training.resume(context.scene, Path(self.folder))


class RemoveFromList(OnRunFolder, bpy.types.Operator):
    bl_idname = "refgs.forget"
    bl_label = "Remove from List"
    bl_description = "Remove this run from the list. Its folder stays"

    def work(self, context: bpy.types.Context) -> None:
        training.forget(context.scene, Path(self.folder))


class SendCommand(OnJob, bpy.types.Operator):
    bl_idname = "refgs.tell"
    bl_label = "Send Command to Training"

    command: StringProperty(name="Command", description="pause, resume, stop or cancel")

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return {
            "pause": "Pause the training, and free the machine",
            "resume": "Resume the training",
            "stop": "Finish now, and take the current state as the result",
            "cancel": "Stop. A training can be resumed later",
        }.get(properties.command, "")

    def work(self, context: bpy.types.Context) -> None:
        if self.command == "cancel":
            self.job.stop()
        else:
            self.job.tell(self.command)


class ShowLiveSplats(OnJob, bpy.types.Operator):
    bl_idname = "refgs.watch"
    bl_label = "Show Splats"
    bl_description = "Show or hide the current surfels in the 3D view, in their base colour"

    def work(self, context: bpy.types.Context) -> None:
        live_splats.watch(self.job, context.scene, not live_splats.is_watched(self.job))


class ImportTrained(OnRunFolder, bpy.types.Operator):
    bl_idname = "refgs.import_trained"
    bl_label = "Import"
    bl_description = "Import this run: splats, mesh, recovered light and cameras"

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, Path(self.folder))


class TrainPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_train"
    bl_label = "Train"
    bl_order = 0

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        self.layout.operator(OpenManual.bl_idname, text="", icon="HELP", emboss=False)

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.refgs
        width = letters(context)
        if not preferences.set_up():
            wrapped_text(layout.box(), preferences.status()[1], width, "INFO")
            layout.operator(
                "preferences.addon_show", text="Preferences", icon="PREFERENCES"
            ).module = preferences.PACKAGE
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(settings, "capture")
        row = column.row(align=True)
        row.operator(PhotosFromVideo.bl_idname, icon="FILE_MOVIE")
        row = column.row(align=True)
        row.operator(MakeMasks.bl_idname, icon="MOD_MASK")
        row.operator(PaintStrokes.bl_idname, icon="BRUSH_DATA")
        if canvases():
            column.operator(SaveStrokes.bl_idname, icon="FILE_TICK")
        sub = column.row()
        sub.active = not settings.limited  # the minutes choose everything
        sub.prop(settings, "preset")
        row = column.row(heading="Limit Time", align=True)
        row.prop(settings, "limited", text="")
        sub = row.row()
        sub.active = settings.limited
        sub.prop(settings, "minutes", text="")
        column.prop(settings, "mesh")
        row = column.row(align=True)
        sub = row.row()
        sub.active = training_region(context.scene) is not None
        sub.prop(settings, "region")
        row.operator(AddTrainingRegion.bl_idname, text="", icon="CUBE")
        column.prop(settings, "out")
        head, body = layout.panel("refgs_learned", default_closed=True)
        head.label(text="What to Learn")
        if body is not None:
            body.use_property_split, body.use_property_decorate = True, False
            for name in ("splats", "light", "exposures", "specular", "reflections"):
                body.prop(settings, name)
        row = layout.row(align=True)
        row.operator(CheckCapture.bl_idname, icon="VIEWZOOM")
        row.operator(Train.bl_idname, icon="PLAY")
        # What runs comes first, then what ended last: a report must not push a training out of sight.
        for job in sorted(reversed(jobs.JOBS), key=lambda job: (job.ended, 0 if job.ended else job.serial)):
            if job.program == jobs.TRAINER and job.kind != "batch" and job not in preferences.own_jobs():
                draw_job(layout.box(), context.scene, job, width)
        for known in settings.runs:
            if not any(job.run == Path(known.folder) for job in jobs.JOBS):
                _draw_run(layout.box(), context.scene, Path(known.folder), width)


def draw_job(box: bpy.types.UILayout, scene: bpy.types.Scene, job: jobs.Job, width: int) -> None:
    """Draw a job's progress, results and buttons, on lines of `width` letters."""
    head = box.row()
    icon = {"done": "CHECKMARK", "failed": "ERROR", "cancelled": "PAUSE", "paused": "PAUSE"}.get(job.state, "SORTTIME")
    head.label(text=job.name, icon=icon)
    if job.ended:
        head.operator(Dismiss.bl_idname, text="", icon="X", emboss=False).serial = job.serial
    if job.active and (job.run or ("stage" in job.progress and not job.results)):
        box.progress(factor=fraction(job), text=status_words(job).capitalize())
    if job.line:
        wrapped_text(box, job.line[0].upper() + job.line[1:], width)
    _draw_photos(box, scene, job, width)
    for warning in job.warnings:
        wrapped_text(box, warning[0].upper() + warning[1:], width, "ERROR")
    for line in job.results.get("check", {}).get("lines", ()):
        wrapped_text(box, line.removeprefix("Warning: "), width, "ERROR" if line.startswith("Warning: ") else "NONE")
    draw_capture(box, scene, job)
    if file := job.results.get("export", {}).get("display_splats"):
        wrapped_text(box, f"Wrote {file}", width)
    _draw_curve(box, job)
    if shown := preview_icon(job):
        box.template_icon(icon_value=shown, scale=10)
    _draw_controls(box, job)
    if job.no_cameras:
        box.operator(FindCameras.bl_idname, icon="OUTLINER_OB_CAMERA")
    elif job.state == "failed":
        box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(job.log)
    for decision in job.decided.values():
        wrapped_text(box, decision[0].upper() + decision[1:], width, "DOT")
    if job.run and job.ended:
        _draw_run(box, scene, job.run, width)
    elif job.run:
        draw_decisions(box, scene, job.run, width)


def _draw_curve(box: bpy.types.UILayout, job: jobs.Job) -> None:
    """Draw how good a training is by now, and its curve of error against time."""
    if not job.curve:
        return
    facts = job.progress
    box.label(text=f"{facts['psnr']:.1f} dB{f', held out {job.held_out[-1][1]:.1f} dB' if job.held_out else ''}")
    box.label(text=f"{facts['splats'] / 1000:.1f} k splats after {_duration(facts['seconds'])}")
    if shown := curve_icon(job):
        box.template_icon(icon_value=shown, scale=6)
        ends = box.row()
        ends.label(text=_duration(min(seconds for seconds, _ in job.curve + job.held_out)))
        ends.label(text="log time")
        ends.label(text=_duration(job.curve[-1][0]))


def _draw_controls(box: bpy.types.UILayout, job: jobs.Job) -> None:
    """Draw the buttons that pause, finish, stop, show or keep a job."""
    if job.run and job.state in ("running", "paused") and "train" not in job.results:
        row = box.row(align=True)
        if job.state == "paused":
            command_button(row, job, "resume", text="Resume", icon="PLAY")
        else:
            command_button(row, job, "pause", text="Pause", icon="PAUSE")
        command_button(row, job, "stop", text="Finish", icon="CHECKMARK")
        command_button(row, job, "cancel", text="Stop", icon="CANCEL")
        watched = live_splats.is_watched(job)
        icon = "HIDE_OFF" if watched else "HIDE_ON"
        box.operator(ShowLiveSplats.bl_idname, icon=icon, depress=watched).serial = job.serial
    elif not job.ended:
        command_button(box, job, "cancel", text="Stop", icon="CANCEL")
    if job.run and not job.ended:
        icon = "CHECKBOX_HLT" if job.kept else "CHECKBOX_DEHLT"
        box.operator(KeepTraining.bl_idname, icon=icon, emboss=False).serial = job.serial


def _draw_photos(box: bpy.types.UILayout, scene: bpy.types.Scene, job: jobs.Job, width: int) -> None:
    """Draw how many photos or masks a job has made, and their folder's path."""
    if found := job.results.get("frames"):
        out = f"{found['blurred']} were blurred, {found['duplicates']} showed what the one before did"
        wrapped_text(box, f"{found['photos']} photos of {found['frames']} frames; {out}", width)
        wrapped_text(box, str(Path(found["capture"], "images")), width)
        if scene.refgs.capture and Path(bpy.path.abspath(scene.refgs.capture)) == Path(found["capture"]):
            box.operator(FindCameras.bl_idname, icon="OUTLINER_OB_CAMERA")
    if found := job.results.get("masks"):
        kept = f", {found['kept']} of yours kept" if found["kept"] else ""
        wrapped_text(box, f"{found['made']} masks made{kept}: {masks_root(Path(found['capture'])) / 'masks'}", width)


def draw_status(self, context: bpy.types.Context) -> None:
    """Draw a training's progress in the status bar."""
    job = next((job for job in jobs.JOBS if job.run and job.active), None)
    if job is not None:
        row = self.layout.row()
        row.ui_units_x = 14
        row.progress(factor=fraction(job), text=f"{job.name}: {status_words(job)}")


def fraction(job: jobs.Job) -> float:
    """Return how much of a job, or of its present stage, is done, 0..1."""
    facts = job.progress
    if "train" in job.results:  # the mesh is being made
        return job.fraction
    return facts["done" if "stage" in facts else "iteration"] / max(facts["total"], 1) if facts else 0.0


def status_words(job: jobs.Job) -> str:
    """Describe the progress of a job, such as "paused" or "3:20 left"."""
    if job.state == "paused":
        return "paused"
    if "train" in job.results:
        return f"making the mesh, {job.fraction:.0%}"
    if not job.progress:
        return "waiting" if job.state == "waiting" else "starting"
    if "stage" in job.progress:
        stage = job.progress["stage"]
        if stage == "batch":
            done, total, failed = (job.progress[key] for key in ("done", "total", "failed"))
            return count_words(done - failed, total, failed)
        if stage == "frames":
            return "{done} frames read, {kept} kept, {blurred} blurred".format(**job.progress)
        if stage in ("points", "looking", "reading", "carving", "edges"):
            return f"making masks: {stage}"
        if stage == "mesh":
            return f"making the mesh, {fraction(job):.0%}"
        return "learning colours" if stage == "colours" else f"finding cameras: {stage}"
    return f"{_duration(job.progress['seconds_left'])} left"


def count_words(done: int, total: int, failed: int) -> str:
    """Describe the state of a batch, such as "2 of 5 done, 1 failed"."""
    return f"{done} of {total} done" + (f", {failed} failed" if failed else "")


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def command_button(layout: bpy.types.UILayout, job: jobs.Job, command: str, *, text: str, icon: str) -> None:
    """Draw a button that sends a command to a job."""
    button = layout.operator(SendCommand.bl_idname, text=text, icon=icon)
    button.serial, button.command = job.serial, command


def _draw_run(box: bpy.types.UILayout, scene: bpy.types.Scene, folder: Path, width: int) -> None:
    """Draw a run of the scene's list, its progress or button, and its open decisions."""
    state = jobs.run_state(folder)
    row = box.row(align=True)
    if state == "finished":
        row.operator(ImportTrained.bl_idname, text=f"Import {folder.name}", icon="IMPORT").folder = str(folder)
    elif state == "stopped":
        row.operator(Resume.bl_idname, text=f"Resume {folder.name}", icon="PLAY").folder = str(folder)
    elif state == "training":
        wrapped_text(row, f"{folder.name} is being trained", width - 6, "SORTTIME")
    else:
        wrapped_text(row, f"{folder.name} does not exist", width - 6, "GHOST_DISABLED")
        row.operator(FindRun.bl_idname, text="", icon="FILE_FOLDER").folder = str(folder)
    row.operator(RemoveFromList.bl_idname, text="", icon="X").folder = str(folder)
    if state == "training":
        follow_other_processes()
        part, text = other_process_status(folder)
        row = box.row(align=True)
        row.progress(factor=part, text=text)
        if jobs.run_progress(folder) and not jobs.stop_requested(folder):
            row.operator(StopRun.bl_idname, icon="CANCEL").folder = str(folder)
    draw_decisions(box, scene, folder, width)


def other_process_status(folder: Path) -> tuple[float, str]:
    """Return the progress, 0..1, and a description of a run that another process trains."""
    facts = jobs.run_progress(folder)
    if not facts:
        return (1.0, "Making the mesh") if (folder / "splats.ply").exists() else (0.0, "Starting")
    part = facts["iteration"] / max(facts["total"], 1)
    return part, "Stopping" if jobs.stop_requested(folder) else f"{part:.0%}, {_duration(facts['seconds_left'])} left"


CLASSES = (
    CheckCapture,
    FindCameras,
    AddTrainingRegion,
    Train,
    Resume,
    RemoveFromList,
    SendCommand,
    ShowLiveSplats,
    ImportTrained,
    TrainPanel,
)


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(draw_status)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
