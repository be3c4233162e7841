"""Draw the panel Train Many, below the panel Train, and define its operators.

A batch is the training of all captures in a folder. The panel starts a batch, and shows a table with a row for each run.
"""

import time
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import IntProperty

from ... import jobs
from ...preferences import letters, wrapped_text
from ...ui.icons import thumbnail
from ...ui.operators import Dismiss, ReportsErrors
from ...ui.panels import Tab
from ..scene import batch_assets, batch_table, many
from ..timers import follow_batch
from .closing import KeepTraining, StopRun
from .on_capture import has_trainer
from .train_panel import ImportTrained, TrainPanel, command_button, count_words, fraction, status_words

ROWS = 5  # of the table, as it is drawn at first
_ICONS = {"waiting": "SORTTIME", "running": "PLAY", "done": "CHECKMARK", "failed": "ERROR", "stopped": "PAUSE"}


class TrainMany(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.train_many"
    bl_label = "Train Many"
    bl_description = (
        "Find cameras, make masks, train, and make the mesh of each capture in the folder, in separate processes. "
        "What is done already is not done again; what was stopped is resumed"
    )
    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not has_trainer(cls):
            return False
        cls.poll_message_set("Choose the folder of the captures first")
        return bool(context.scene.refgs.many.captures)

    def work(self, context: bpy.types.Context) -> None:
        many.train_many(context.scene)


class ImportAsAssets(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.import_as_assets"
    bl_label = "Import as Assets"
    bl_description = (
        "Make each finished run an asset, in an asset library among the results, which Blender's asset browser then "
        "shows. Assets that are there already stay as they are"
    )
    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Choose the folder of the captures, or of their results, first")
        return many.results_folder(context.scene) is not None

    def work(self, context: bpy.types.Context) -> None:
        job = batch_assets.import_as_assets(many.results_folder(context.scene))
        while bpy.app.background and not job.ended:  # there are no timers
            jobs.poll()
            time.sleep(0.05)


class ChooseRun(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.choose_run"
    bl_label = "Select Run"
    bl_description = "Select this run: below the table is what it failed by, or a button that imports it"
    bl_options: ClassVar = {"INTERNAL"}

    index: IntProperty(name="Index", description="Of the row in the table")

    def work(self, context: bpy.types.Context) -> None:
        context.window_manager.refgs_row = self.index


class RunList(bpy.types.UIList):
    """Draw a table's rows, one for each run of a batch (the training of many captures): a picture, the name, and below it the progress."""

    bl_idname = "REFGS_UL_runs"

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index):
        row = layout.row()
        cell = row.row()
        cell.ui_units_x = 2
        picture = thumbnail(Path(item.picture)) if item.picture else 0
        if picture:
            cell.template_icon(icon_value=picture, scale=2)
        else:
            cell.label(text="")
        column = row.column(align=True)
        column.label(text=item.name)
        line = column.row()
        line.alignment = "LEFT"
        # Blender selects a row by a click on its first line only.
        button = line.operator(ChooseRun.bl_idname, text=item.words, icon=_ICONS.get(item.state, "NONE"), emboss=False)
        button.index = index


class ManyPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_many"
    bl_label = "Train Many"
    bl_parent_id = TrainPanel.bl_idname
    bl_options: ClassVar = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.refgs.many
        width = letters(context)
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        for name in ("captures", "results", "preset"):
            column.prop(settings, name)
        layout.operator(TrainMany.bl_idname, icon="PLAY")
        for job in jobs.JOBS:
            if job.kind == "batch":
                _draw_batch(layout.box(), job, width)
        folder = many.results_folder(context.scene)
        if folder is None:
            return
        follow_batch(folder)
        own = any(job.run == folder / jobs.LOGS and not job.ended for job in jobs.JOBS)
        if not own and jobs.run_state(folder / jobs.LOGS) == "training":
            _draw_other_process(layout.box(), context, folder)
        if batch_table.is_shown(folder) and context.window_manager.refgs_rows:
            _draw_table(layout, context, folder, width)
        for job in jobs.JOBS:
            if job.kind == "library":
                _draw_library(layout.box(), job, width)


def _draw_batch(box: bpy.types.UILayout, job: jobs.Job, width: int) -> None:
    """Draw the progress and buttons of this Blender's batch on lines of `width` letters."""
    head = box.row()
    icon = {"done": "CHECKMARK", "failed": "ERROR", "cancelled": "PAUSE"}.get(job.state, "SORTTIME")
    head.label(text=job.name, icon=icon)
    if job.ended:
        head.operator(Dismiss.bl_idname, text="", icon="X", emboss=False).serial = job.serial
    if job.active or (job.ended and job.progress):
        box.progress(factor=fraction(job), text=status_words(job).capitalize())
    if job.line:
        wrapped_text(box, job.line[0].upper() + job.line[1:], width)
    for warning in job.warnings:
        wrapped_text(box, warning[0].upper() + warning[1:], width, "ERROR")
    if not job.ended:
        command_button(box, job, "cancel", text="Stop", icon="CANCEL")
        icon = "CHECKBOX_HLT" if job.kept else "CHECKBOX_DEHLT"
        box.operator(KeepTraining.bl_idname, icon=icon, emboss=False).serial = job.serial
    if job.state == "failed":
        box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(job.log)


def _draw_other_process(box: bpy.types.UILayout, context: bpy.types.Context, folder: Path) -> None:
    """Draw another process's batch: its progress, and a button that stops it."""
    states = [row.state for row in context.window_manager.refgs_rows] if batch_table.is_shown(folder) else []
    done, failed, stopping = states.count("done"), states.count("failed"), jobs.stop_requested(folder / jobs.LOGS)
    text = "Stopping" if stopping else count_words(done, len(states), failed) if states else "Starting"
    box.label(text=folder.name, icon="SORTTIME")
    box.progress(factor=(done + failed) / max(len(states), 1), text=text)
    if not stopping:
        box.operator(StopRun.bl_idname, icon="CANCEL").folder = str(folder / jobs.LOGS)


def _draw_table(layout: bpy.types.UILayout, context: bpy.types.Context, folder: Path, width: int) -> None:
    """Draw the table of a batch's runs, and the selected run's error or import button."""
    manager = context.window_manager
    layout.template_list(RunList.bl_idname, "", manager, "refgs_rows", manager, "refgs_row", rows=ROWS)
    row = batch_table.chosen_row(folder)
    if row is not None and row.what:
        wrapped_text(layout, f"{row.name}: {row.what}", width, "ERROR")
        if row.log:
            layout.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = row.log
    elif row is not None and row.state == "done":
        layout.operator(ImportTrained.bl_idname, text=f"Import {row.name}", icon="IMPORT").folder = str(
            folder / row.name
        )
    layout.operator(ImportAsAssets.bl_idname, icon="ASSET_MANAGER")


def _draw_library(box: bpy.types.UILayout, job: jobs.Job, width: int) -> None:
    """Draw the progress or the result of a job that turns runs into assets."""
    row = box.row()
    row.label(text=job.name, icon={"done": "CHECKMARK", "failed": "ERROR"}.get(job.state, "SORTTIME"))
    row.operator(Dismiss.bl_idname, text="", icon="X", emboss=False).serial = job.serial
    if job.state == "done":
        made = job.results["library"]
        wrapped_text(box, f"{made['written']} assets were made: choose {job.name} in the asset browser", width)
        for what in made["failed"]:
            wrapped_text(box, what, width, "ERROR")
    elif job.state == "failed":
        wrapped_text(box, job.line[0].upper() + job.line[1:], width)
        box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(job.log)
    else:
        box.progress(factor=job.fraction, text=job.line)


CLASSES = (TrainMany, ImportAsAssets, ChooseRun, RunList, ManyPanel)
