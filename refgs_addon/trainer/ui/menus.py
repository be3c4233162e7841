"""Add what the trainer does to the menu RefGS, so that F3 finds the panels' buttons."""

import bpy

from ...ui.menus import MaterialsMenu, Menu, draw_buttons
from ..scene.questions import KINDS
from . import hint_buttons, many_panel, photo_buttons, train_panel


class TrainMenu(bpy.types.Menu):
    bl_idname = "REFGS_MT_train"
    bl_label = "Train"

    def draw(self, context: bpy.types.Context) -> None:
        draw_buttons(
            self.layout,
            photo_buttons.PhotosFromVideo,
            train_panel.CheckCapture,
            train_panel.FindCameras,
            photo_buttons.MakeMasks,
            photo_buttons.PaintStrokes,
            photo_buttons.SaveStrokes,
            train_panel.AddTrainingRegion,
            train_panel.Train,
            many_panel.TrainMany,
            many_panel.ImportAsAssets,
        )


def _train_menu(self, context: bpy.types.Context) -> None:
    self.layout.menu(TrainMenu.bl_idname)


def _hints(self, context: bpy.types.Context) -> None:
    for kind in KINDS:
        text = f"This Part Is {kind.capitalize()}"
        self.layout.operator(hint_buttons.Hint.bl_idname, text=text).kind = kind


CLASSES = (TrainMenu,)


def register() -> None:
    Menu.prepend(_train_menu)
    MaterialsMenu.append(_hints)


def unregister() -> None:
    MaterialsMenu.remove(_hints)
    Menu.remove(_train_menu)
