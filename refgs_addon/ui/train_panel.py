"""The Train panel and its buttons."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import IntProperty, StringProperty

from .. import jobs, preferences
from ..job_timers import follow_elsewhere
from ..preferences import lines
from ..scene import live_splats, training
from ..scene.regions import add_training_region, training_region
from .checked_capture import draw_capture
from .closing import Keep, StopRun
from .icons import curve, picture
from .operators import Door, choose, has_trainer, import_run_folder
from .panels import Tab


def has_capture(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether there is something to train, and a trainer; the button's tooltip says what is missing."""
    if not has_trainer(operator):
        return False
    operator.poll_message_set("Choose the capture's folder first")
    return bool(context.scene.refgs.capture)


class CheckCapture(Door, bpy.types.Operator):
    bl_idname = "refgs.check_capture"
    bl_label = "Check"
    bl_description = "Read all of the capture's photos and cameras, and say what is wrong with them"
    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_capture(cls, context)

    def work(self, context: bpy.types.Context) -> None:
        training.check(context.scene)


class FindCameras(Door, bpy.types.Operator):
    bl_idname = "refgs.find_cameras"
    bl_label = "Find Cameras"
    bl_description = "Find where the photos were taken from, from the photos alone"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        training.find_cameras(context.scene)


class AddTrainingRegion(Door, bpy.types.Operator):
    bl_idname = "refgs.add_training_region"
    bl_label = "Add Region"
    bl_description = (
        "Add a box, or select the one there is: move, turn and scale it until it stands with the object and holds it. "
        "Only what lies in it comes out, and the box's own up, its Z axis, is the result's up"
    )

    def work(self, context: bpy.types.Context) -> None:
        choose(context, add_training_region(context.scene))


class Train(Door, bpy.types.Operator):
    bl_idname = "refgs.train"
    bl_label = "Train"
    bl_description = "Learn surfels, materials and light from the photos, in a process of its own: Blender stays yours"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_capture(cls, context)

    def work(self, context: bpy.types.Context) -> None:
        training.train(context.scene)


class Resume(Door, bpy.types.Operator):
    bl_idname = "refgs.resume"
    bl_label = "Go On"
    bl_description = "Go on with this training from where it was stopped"
    bl_options: ClassVar = {"REGISTER"}

    folder: StringProperty(name="Run Folder")

    def work(self, context: bpy.types.Context) -> None:
        training.resume(context.scene, Path(self.folder))


class Forget(Door, bpy.types.Operator):
    bl_idname = "refgs.forget"
    bl_label = "Take off the List"
    bl_description = "Do not list this run any longer; its folder stays as it is"

    folder: StringProperty(name="Run Folder")

    def work(self, context: bpy.types.Context) -> None:
        training.forget(context.scene, Path(self.folder))


class Tell(Door, bpy.types.Operator):
    bl_idname = "refgs.tell"
    bl_label = "Tell the Training"
    bl_options: ClassVar = {"REGISTER"}

    number: IntProperty(name="Number", description="Of the job in the list")
    command: StringProperty(name="Command", description="pause, resume, stop or cancel")

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return {
            "pause": "Let the training rest, and the machine with it",
            "resume": "Let the training go on",
            "stop": "Good enough: take what has been learned so far as the result",
            "cancel": "Stop here; a training can be gone on with later",
        }.get(properties.command, "")

    def work(self, context: bpy.types.Context) -> None:
        job = jobs.JOBS[self.number]
        if self.command == "cancel":
            job.stop()
        else:
            job.tell(self.command)


class Watch(Door, bpy.types.Operator):
    bl_idname = "refgs.watch"
    bl_label = "Show Splats"
    bl_description = "Show the surfels in the 3D view as they are by now, in their base colour; or no longer"
    bl_options: ClassVar = {"REGISTER"}

    number: IntProperty(name="Number", description="Of the job in the list")

    def work(self, context: bpy.types.Context) -> None:
        job = jobs.JOBS[self.number]
        live_splats.watch(job, context.scene, not live_splats.is_watched(job))


class PutAway(Door, bpy.types.Operator):
    bl_idname = "refgs.put_away"
    bl_label = "Put Away"
    bl_description = "Do not show this any longer; what is still being done is stopped first"
    bl_options: ClassVar = {"REGISTER"}

    number: IntProperty(name="Number", description="Of the job in the list")

    def work(self, context: bpy.types.Context) -> None:
        job = jobs.JOBS[self.number]
        if job.ended:
            jobs.JOBS.remove(job)
        else:
            job.stop()


class ImportTrained(Door, bpy.types.Operator):
    bl_idname = "refgs.import_trained"
    bl_label = "Import"
    bl_description = "Import this run: splats, mesh, recovered light and cameras"

    folder: StringProperty(name="Run Folder")

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, Path(self.folder))


class TrainPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_train"
    bl_label = "Train"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.refgs
        width = int(context.region.width / (7 * context.preferences.system.ui_scale)) - 6  # letters
        if not preferences.set_up():
            lines(layout.box(), preferences.state()[1], width, "INFO")
            layout.operator(
                "preferences.addon_show", text="Preferences", icon="PREFERENCES"
            ).module = preferences.PACKAGE
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(settings, "capture")
        sub = column.row()
        sub.active = not settings.limited  # a time says it all
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
        for number, job in enumerate(jobs.JOBS):
            if job.program == jobs.TRAINER and job not in preferences.asked():
                _job(layout.box(), context.scene, number, job, width)
        for known in settings.runs:
            if not any(job.run == Path(known.folder) for job in jobs.JOBS):
                _run(layout.box(), Path(known.folder))


def _job(box: bpy.types.UILayout, scene: bpy.types.Scene, number: int, job: jobs.Job, width: int) -> None:
    head = box.row()
    icon = {"done": "CHECKMARK", "failed": "ERROR", "cancelled": "PAUSE", "paused": "PAUSE"}.get(job.state, "SORTTIME")
    head.label(text=job.name, icon=icon)
    if job.ended:
        head.operator(PutAway.bl_idname, text="", icon="X", emboss=False).number = number
    if job.active and (job.run or ("stage" in job.progress and not job.results)):
        box.progress(factor=_part(job), text=_how_far(job).capitalize())
    if job.line:
        lines(box, job.line[0].upper() + job.line[1:], width)
    for warning in job.warnings:
        lines(box, warning[0].upper() + warning[1:], width, "ERROR")
    for line in job.results.get("check", {}).get("lines", ()):
        lines(box, line.removeprefix("Warning: "), width, "ERROR" if line.startswith("Warning: ") else "NONE")
    draw_capture(box, scene, number, job)
    if file := job.results.get("export", {}).get("display_splats"):
        lines(box, f"Wrote {file}", width)
    if job.curve:
        facts = job.progress
        box.label(text=f"{facts['psnr']:.1f} dB{f', held out {job.held_out[-1][1]:.1f} dB' if job.held_out else ''}")
        box.label(text=f"{facts['splats'] / 1000:.1f} k splats after {_duration(facts['seconds'])}")
        if shown := curve(job):
            box.template_icon(icon_value=shown, scale=6)
            ends = box.row()
            ends.label(text=_duration(min(seconds for seconds, _ in job.curve + job.held_out)))
            ends.label(text="log time")
            ends.label(text=_duration(job.curve[-1][0]))
    if shown := picture(job):
        box.template_icon(icon_value=shown, scale=10)
    if job.run and job.state in ("running", "paused") and "train" not in job.results:
        row = box.row(align=True)
        command = "resume" if job.state == "paused" else "pause"
        _tell(row, number, command, command.title(), "PLAY" if command == "resume" else "PAUSE")
        _tell(row, number, "stop", "Finish", "CHECKMARK")
        _tell(row, number, "cancel", "Stop", "CANCEL")
        watched = live_splats.is_watched(job)
        icon = "HIDE_OFF" if watched else "HIDE_ON"
        box.operator(Watch.bl_idname, icon=icon, depress=watched).number = number
    elif not job.ended:
        _tell(box, number, "cancel", "Stop", "CANCEL")
    if job.run and not job.ended:
        icon = "CHECKBOX_HLT" if job.kept else "CHECKBOX_DEHLT"
        box.operator(Keep.bl_idname, icon=icon, emboss=False).number = number
    if job.no_cameras:
        box.operator(FindCameras.bl_idname, icon="OUTLINER_OB_CAMERA")
    elif job.state == "failed":
        box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(job.log)
    for decision in job.decided.values():
        lines(box, decision[0].upper() + decision[1:], width, "DOT")
    if job.run and job.ended:
        _run(box, job.run)


def draw_status(self, context: bpy.types.Context) -> None:
    """A training's bar in the status bar."""
    job = next((job for job in jobs.JOBS if job.run and job.active), None)
    if job is not None:
        row = self.layout.row()
        row.ui_units_x = 14
        row.progress(factor=_part(job), text=f"{job.name}: {_how_far(job)}")


def _part(job: jobs.Job) -> float:
    """How much of the training, or of a stage of another job, is done, 0..1."""
    facts = job.progress
    return facts["done" if "stage" in facts else "iteration"] / max(facts["total"], 1) if facts else 0.0


def _how_far(job: jobs.Job) -> str:
    """A few words on where a job is."""
    if job.state == "paused":
        return "paused"
    if "train" in job.results:
        return "making the mesh"
    if not job.progress:
        return "waiting" if job.state == "waiting" else "starting"
    if "stage" in job.progress:
        stage = job.progress["stage"]
        return {"colours": "learning colours", "baking": "baking textures"}.get(stage, f"finding cameras: {stage}")
    return f"{_duration(job.progress['seconds_left'])} left"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def _tell(layout: bpy.types.UILayout, number: int, command: str, text: str, icon: str) -> None:
    button = layout.operator(Tell.bl_idname, text=text, icon=icon)
    button.number, button.command = number, command


def _run(box: bpy.types.UILayout, folder: Path) -> None:
    """What can be done with a run folder."""
    state = jobs.run_state(folder)
    row = box.row(align=True)
    if state == "finished":
        row.operator(ImportTrained.bl_idname, text=f"Import {folder.name}", icon="IMPORT").folder = str(folder)
    elif state == "stopped":
        row.operator(Resume.bl_idname, text=f"Go On with {folder.name}", icon="PLAY").folder = str(folder)
    elif state == "training":
        row.label(text=f"{folder.name} is being trained", icon="SORTTIME")
    else:
        row.label(text=f"{folder.name} is not there", icon="GHOST_DISABLED")
    row.operator(Forget.bl_idname, text="", icon="X").folder = str(folder)
    if state == "training":
        follow_elsewhere()
        part, text = how_far_elsewhere(folder)
        row = box.row(align=True)
        row.progress(factor=part, text=text)
        if jobs.run_progress(folder) and not jobs.stops(folder):
            row.operator(StopRun.bl_idname, icon="CANCEL").folder = str(folder)


def how_far_elsewhere(folder: Path) -> tuple[float, str]:
    """How much of a run that a process which is not of this Blender trains is done, 0..1, and a few words on it."""
    facts = jobs.run_progress(folder)
    if not facts:
        return (1.0, "Making the mesh") if (folder / "splats.ply").exists() else (0.0, "Starting")
    part = facts["iteration"] / max(facts["total"], 1)
    return part, "Stopping" if jobs.stops(folder) else f"{part:.0%}, {_duration(facts['seconds_left'])} left"


CLASSES = (
    CheckCapture,
    FindCameras,
    AddTrainingRegion,
    Train,
    Resume,
    Forget,
    Tell,
    Watch,
    PutAway,
    ImportTrained,
    TrainPanel,
)


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(draw_status)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
