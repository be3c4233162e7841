"""Draw the Light panel, in which the artist chooses the panorama that lights the scene."""

import math
import os
from pathlib import Path

import bpy
from bpy.props import EnumProperty, FloatProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..errors import InputError
from ..nodes.panorama_world import IMAGE, RECOVERED, ROTATION, STRENGTH, get_light, is_panorama
from ..preferences import hdri_folder
from ..scene.world_light import correct_diffuse, hdris, match_light, relight
from . import icons
from .operators import ReportsErrors
from .panels import Tab

RECOVERED_LIGHT, OTHER = 0, 1  # numbers of the lights that are no files; OTHER is not in the list
# Numbers of the files, in the order in which they were first listed. Blender's buttons hold an enum's number as a float32, which rounds
# numbers above 2 ** 24.
_numbers: dict[str, int] = {}
# All texts ever listed: an open menu points at them, and Blender keeps no references to them.
_texts: dict[str, str] = {}


def _lights(self, context: bpy.types.Context) -> list[tuple[str, str, str, int, int]]:
    world, listed = bpy.context.scene.world, []
    shown = world.node_tree.nodes[IMAGE].image if is_panorama(world) else None
    if is_panorama(world) and world.get(RECOVERED) is not None:
        icon = icons.thumbnail(Path(bpy.path.abspath(world[RECOVERED].filepath)))
        listed.append(("RECOVERED", "Recovered", "Light recovered from the photos", icon, RECOVERED_LIGHT))
    files = hdris(hdri_folder())
    for file in files:
        path, name = _keep(str(file)), _keep(file.stem.capitalize())
        listed.append((path, name, path, icons.thumbnail(file), _number(file)))
    if _shown(world, files) == OTHER:
        listed.append(("OTHER", _keep(shown.name if shown else "None"), "Light of the scene", 0, OTHER))
    return listed


def _keep(text: str) -> str:
    """Return the text itself, or an equal one that was listed before. It is never freed."""
    return _texts.setdefault(text, text)


def _number(file: Path) -> int:
    """Return a panorama's number in the menu of lights. It stays the same until Blender closes."""
    return _numbers.setdefault(str(file), OTHER + 1 + len(_numbers))


def _shown(world: bpy.types.World | None, files: list[Path]) -> int:
    image = world.node_tree.nodes[IMAGE].image if is_panorama(world) else None
    if image is None:
        return OTHER
    if image == world.get(RECOVERED):
        return RECOVERED_LIGHT
    number = _number(Path(os.path.normpath(bpy.path.abspath(image.filepath))))
    return number if any(_number(file) == number for file in files) else OTHER


def _get(self) -> int:
    return _shown(bpy.context.scene.world, hdris(hdri_folder()))


def _set(self, number: int) -> None:
    chosen = next((Path(item[0]) for item in _lights(self, bpy.context) if item[4] == number and number > OTHER), None)
    if chosen is None and number != RECOVERED_LIGHT:
        return
    world = bpy.context.scene.world
    _, rotation, strength = get_light(world) if is_panorama(world) and chosen else (None, (0.0, 0.0, 0.0), 1.0)
    try:
        relight(bpy.context.scene, chosen, rotation[2], strength)
    except InputError as error:
        text = str(error)
        bpy.context.window_manager.popup_menu(lambda menu, _: menu.layout.label(text=text), title="RefGS", icon="ERROR")


class Relight(ReportsErrors, ImportHelper, bpy.types.Operator):
    bl_idname = "refgs.relight"
    bl_label = "Open HDRI"
    bl_description = "Light the scene with a panorama. The recovered light is kept"

    filter_glob: StringProperty(default="*.exr;*.hdr", options={"HIDDEN"})
    rotation: FloatProperty(
        name="Rotation", description="Rotation of the light, counter-clockwise seen from above", subtype="ANGLE",
        soft_min=-math.pi, soft_max=math.pi,
    )  # fmt: skip
    strength: FloatProperty(name="Strength", default=1.0, min=0.0, soft_max=10.0)

    def work(self, context: bpy.types.Context) -> None:
        relight(context.scene, Path(bpy.path.abspath(self.filepath)), self.rotation, self.strength)


class RecoveredLight(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.recovered_light"
    bl_label = "Recovered Light"
    bl_description = "Light the scene with the panorama recovered from the photos"

    def work(self, context: bpy.types.Context) -> None:
        relight(context.scene, None)


class MatchLight(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.match_light"
    bl_label = "Match Recovered Light"
    bl_description = "Rotate and scale the HDRI to match the recovered light as closely as possible"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        world = context.scene.world
        cls.poll_message_set("Import a run with a light, then choose an HDRI")
        return is_panorama(world) and world.get(RECOVERED) not in (None, world.node_tree.nodes[IMAGE].image)

    def work(self, context: bpy.types.Context) -> None:
        match_light(context.scene)


class LightPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_light"
    bl_label = "Light"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        layout, world = self.layout, context.scene.world
        layout.template_icon_view(context.window_manager, "refgs_light", show_labels=True, scale=6, scale_popup=6)
        column = layout.column(align=True)
        column.operator(Relight.bl_idname, icon="FILE_FOLDER")
        if not is_panorama(world):
            return
        nodes = world.node_tree.nodes
        if nodes[IMAGE].image is not None:
            column.label(text=nodes[IMAGE].image.name, icon="IMAGE_DATA")
        if world.get(RECOVERED) is not None:
            column.operator(RecoveredLight.bl_idname, icon="LOOP_BACK")
            column.operator(MatchLight.bl_idname, icon="SNAP_ON")
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(nodes[ROTATION].inputs["Rotation"], "default_value", index=2, text="Rotation")
        column.prop(nodes[STRENGTH].inputs["Strength"], "default_value", text="Strength")


CLASSES = (Relight, RecoveredLight, MatchLight, LightPanel)


@bpy.app.handlers.persistent
def _follow_world(scene: bpy.types.Scene, *_) -> None:
    """Update imported runs' diffuse light in Eevee after the world was rotated or replaced."""
    correct_diffuse(scene)


def register() -> None:
    bpy.types.WindowManager.refgs_light = EnumProperty(
        name="Light", description="Panorama that lights the scene", items=_lights, get=_get, set=_set
    )
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.frame_change_post):
        handlers.append(_follow_world)


def unregister() -> None:
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.frame_change_post):
        handlers.remove(_follow_world)
    del bpy.types.WindowManager.refgs_light
