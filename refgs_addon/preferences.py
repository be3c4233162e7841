"""Show the add-on's preferences, and find the folders of its own files."""

import textwrap
from pathlib import Path

import bpy
from bpy.props import StringProperty

PACKAGE = __package__.removesuffix(".refgs_addon")


class Preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    hdris: StringProperty(
        name="HDRIs",
        description="Folder with your own panoramas (EXR or HDR), shown beside those that come with Blender",
        subtype="DIR_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(self, "hdris")


def hdri_folder() -> Path | None:
    """Return the folder of the artist's panoramas, or None if none is chosen."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return Path(bpy.path.abspath(addon.preferences.hdris)) if addon and addon.preferences.hdris else None


def log_file(name: str) -> Path:
    """Return the path of the log of the job `name`."""
    return user_folder("logs") / f"{name}.txt"


def user_folder(name: str, package: str = PACKAGE) -> Path:
    """Return the path of the folder `name` for data that updates of the add-on keep. `package` is the add-on."""
    try:
        return Path(bpy.utils.extension_path_user(package, path=name))
    except ValueError:
        return Path(bpy.app.tempdir) / name


def letters(context: bpy.types.Context) -> int:
    """Return how many letters fit into a line of the sidebar that is drawn."""
    return int(context.region.width / (7 * context.preferences.system.ui_scale)) - 6


def wrapped_text(layout: bpy.types.UILayout, text: str, width: int, icon: str = "NONE") -> None:
    """Draw a text on lines of at most `width` letters."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    width = max(width - (0 if icon == "NONE" else 3), 20)
    for line in textwrap.wrap(text, width, break_on_hyphens=False):
        column.label(text=line, icon=icon)
        icon = "NONE" if icon == "NONE" else "BLANK1"


CLASSES = (Preferences,)
