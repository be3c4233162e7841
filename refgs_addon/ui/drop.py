"""Handle files that are dropped on the 3D view. A run.toml imports the run folder that it is in."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..errors import InputError
from .operators import ReportsErrors, import_run_folder


class Drop(ReportsErrors):
    """Store the path of a dropped file for the operators that handle it."""

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})

    def folder(self, name: str) -> Path:
        """Return the dropped file's folder. Raises InputError unless the file's name begins with `name`."""
        file = Path(bpy.path.abspath(self.filepath))
        if not file.name.startswith(name):
            raise InputError(
                f"{file.name} is not a {name} file: drop run.toml of a run or transforms.json of a capture"
            )
        return file.parent


class DropRun(Drop, bpy.types.Operator):
    bl_idname = "refgs.drop_run"
    bl_label = "Import RefGS Run"
    bl_description = "Import the run of this run.toml"

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, self.folder("run"))


class OnView:
    """Let file handlers accept only files that are dropped on the 3D view."""

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


class RunFile(OnView, bpy.types.FileHandler):
    bl_idname = "REFGS_FH_run"
    bl_label = "RefGS Run"
    bl_import_operator = DropRun.bl_idname
    bl_file_extensions = ".toml"


CLASSES = (DropRun, RunFile)
