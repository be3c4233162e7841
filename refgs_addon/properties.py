"""Define the properties stored in the .blend: the capture (a folder with photos), the training settings and the list of runs.

Only the trainer's extension shows most of them. They are defined here so that a file keeps them, and their paths, without it.
"""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .compat import BLEND_RELATIVE
from .scene.run_parts import ROOT


class KnownRun(bpy.types.PropertyGroup):
    """Store one run of the scene's list: its folder, capture and confirmed decisions."""

    folder: StringProperty(subtype="DIR_PATH", options=BLEND_RELATIVE)
    capture: StringProperty(subtype="DIR_PATH", options=BLEND_RELATIVE)
    confirmed: StringProperty(description="Decisions of the training that the artist keeps, as need=answer")


PRESETS = [
    ("quick", "Quick", "A few minutes on a laptop: photos of 400 pixels, a coarse mesh"),
    ("standard", "Standard", "Finer light, mesh and textures, photos of 800 pixels; several times as long"),
    ("paper", "Paper", "The published schedule of 58,000 iterations: for a graphics card"),
]


class Many(bpy.types.PropertyGroup):
    """Store the settings of the panel Train Many."""

    captures: StringProperty(
        name="Captures",
        description="Folder of captures: each folder in it has the photos of one",
        subtype="DIR_PATH",
        options=BLEND_RELATIVE,
    )
    results: StringProperty(
        name="Results",
        description="Folder for the results, a run folder for each capture. If left empty, a folder beside the captures",
        subtype="DIR_PATH",
        options=BLEND_RELATIVE,
    )
    preset: EnumProperty(name="Quality", items=PRESETS, default="quick")


class Training(bpy.types.PropertyGroup):
    capture: StringProperty(
        name="Capture",
        description="Folder with the photos, and with their cameras if there are any: NeRF-Blender, nerfstudio or COLMAP",
        subtype="DIR_PATH",
        options=BLEND_RELATIVE,
    )
    out: StringProperty(
        name="Run Folder",
        description="New or empty folder for the result. If left empty, a folder beside the capture",
        subtype="DIR_PATH",
        options=BLEND_RELATIVE,
    )
    preset: EnumProperty(name="Quality", items=PRESETS, default="quick")
    limited: BoolProperty(
        name="Limit Time",
        description="Finish within a number of minutes: it chooses the splats, photo size and iterations in place of the quality",
    )
    minutes: FloatProperty(
        name="Minutes",
        description="Time for the training; the mesh comes after it",
        default=5.0,
        min=0.05,
        soft_min=1.0,
        soft_max=120.0,
    )
    mesh: BoolProperty(
        name="Make Mesh", description="Fuse a mesh and bake its textures after the training", default=True
    )
    splats: IntProperty(
        name="Splats at Most",
        description="Maximum number of splats. More show finer detail, but need more time and memory. 0 takes the quality's number",
        min=0,
        max=10_000_000,
        soft_max=200_000,
        step=1000,
    )
    light: EnumProperty(
        name="Light",
        items=[
            (
                "auto",
                "Auto",
                "Find out from the photos, and show the answer during training. Paper assumes that it stands still",
            ),
            ("world", "Stands Still", "You walked around the object"),
            (
                "camera",
                "Turns",
                "It turns with the camera: the object stood on a turntable, or the lamp was fixed to the camera",
            ),
        ],
    )
    exposures: EnumProperty(
        name="Exposure",
        items=[
            (
                "auto",
                "Auto",
                "Learn each photo's exposure and white balance, unless they agree. Paper assumes one for all",
            ),
            ("on", "Each Photo's", "The camera chose an exposure, and perhaps a white balance, for each photo"),
            ("off", "One for All", "Exposure and white balance were locked"),
        ],
    )
    specular: EnumProperty(
        name="Gloss",
        description="Specular reflection of the light",
        items=[
            ("auto", "Auto", "Leave it out where it explains nothing in the photos. Paper always learns it"),
            ("on", "Glossy", "Learn metallic and roughness in any case"),
            ("off", "Matte", "No specular reflection: faster, and the splats have only a base colour"),
        ],
    )
    reflections: EnumProperty(
        name="Reflections",
        description="Reflections of the object in itself",
        items=[
            ("auto", "Auto", "Leave them out where the object hardly reflects itself. Paper always traces them"),
            ("on", "Object Too", "Trace the object's reflections in itself, however faint"),
            ("off", "Light Only", "Do not trace the object's reflections in itself: faster"),
        ],
    )
    region: PointerProperty(
        name="Region",
        description="Box among the photos' cameras: only what is inside is trained. Its Z axis is the result's up. "
        "Without a box, everything in the photos is trained",
        type=bpy.types.Object,
        poll=lambda self, item: item.type == "EMPTY",
    )
    runs: CollectionProperty(type=KnownRun)
    many: PointerProperty(type=Many)


CLASSES = (KnownRun, Many, Training)


def register() -> None:
    bpy.types.Scene.refgs = PointerProperty(type=Training, name="RefGS")
    bpy.types.Object.refgs_longest_side = FloatProperty(
        name="Longest Side",
        description="Size of the object: the longest side of a box around it. Photos do not tell it; type it in",
        unit="LENGTH",
        min=1e-6,
        get=_longest_side,
        set=_scale_to,
    )


def unregister() -> None:
    del bpy.types.Scene.refgs, bpy.types.Object.refgs_longest_side


def _longest_side(item: bpy.types.Object) -> float:
    return item.get(ROOT, 0.0) * max(map(abs, item.scale))


def _scale_to(item: bpy.types.Object, metres: float) -> None:
    """Scale a run's Empty uniformly until the run's longest side is `metres` long."""
    item.scale *= metres / max(_longest_side(item), 1e-12)
