"""What a .blend file keeps of RefGS: the capture, how to train it, and where its runs are."""

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


class KnownRun(bpy.types.PropertyGroup):
    """A run folder that was trained from this file."""

    folder: StringProperty(subtype="DIR_PATH")
    capture: StringProperty(subtype="DIR_PATH")


class Training(bpy.types.PropertyGroup):
    capture: StringProperty(
        name="Capture",
        description="The folder with the photos, and their cameras if there are any: NeRF-Blender, nerfstudio or COLMAP",
        subtype="DIR_PATH",
    )
    out: StringProperty(
        name="Run Folder",
        description="Where the result goes: a new or an empty folder. Left empty, one beside the capture",
        subtype="DIR_PATH",
    )
    preset: EnumProperty(
        name="Quality",
        items=[
            ("quick", "Quick", "A few minutes on a laptop: photos of 400 pixels, a coarse mesh"),
            ("standard", "Standard", "Finer light, mesh and textures, photos of 800 pixels; several times as long"),
            ("paper", "Paper", "The published schedule, 58,000 iterations: for a graphics card"),
        ],
        default="quick",
    )
    limited: BoolProperty(
        name="Limit Time",
        description="Be done after so many minutes: splats, the photos' size and iterations are chosen for that, in place of the quality",
    )
    minutes: FloatProperty(
        name="Minutes",
        description="When all but the mesh is to be done",
        default=5.0,
        min=0.05,
        soft_min=1.0,
        soft_max=120.0,
    )
    mesh: BoolProperty(
        name="Make Mesh", description="Fuse a mesh and bake its textures when the training has ended", default=True
    )
    splats: IntProperty(
        name="Splats at Most",
        description="More of them show finer detail, and take as much longer and as much more memory. 0 leaves it to the quality",
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
                "The photos tell which it is, and what they told is shown while it trains; with Paper it stands still",
            ),
            ("world", "Stands Still", "You walked around the object"),
            ("camera", "Turns with the Camera", "The object stood on a turntable, or the lamp on the camera"),
        ],
    )
    exposures: EnumProperty(
        name="Exposure",
        items=[
            ("auto", "Auto", "Each photo's own is left out where they turn out to agree; with Paper they all have one"),
            ("on", "Each Photo's", "The camera chose an exposure for each photo"),
            ("off", "One for All", "The exposure was locked"),
        ],
    )
    specular: EnumProperty(
        name="Gloss",
        description="What surfaces mirror of the light",
        items=[
            ("auto", "Auto", "Left out where it explains nothing that the photos show, but with Paper"),
            ("on", "Glossy", "Learn metallic and roughness, whatever the photos show"),
            ("off", "Matte", "Nothing mirrors: faster, and the splats have a base colour alone"),
        ],
    )
    reflections: EnumProperty(
        name="Reflections",
        description="Of the object in itself",
        items=[
            ("auto", "Auto", "Left out where the object turns out hardly to mirror itself, but with Paper"),
            ("on", "Of the Object Too", "Trace the object's reflections in itself, however few there are"),
            ("off", "Of the Light Only", "Leave the object's reflections in itself out: faster"),
        ],
    )
    region: PointerProperty(
        name="Region",
        description="A box, among the photos' cameras: only what lies in it comes out, and its own up, its Z axis, is the result's up. "
        "Without one everything that the photos show does",
        type=bpy.types.Object,
        poll=lambda self, item: item.type == "EMPTY",
    )
    runs: CollectionProperty(type=KnownRun)


CLASSES = (KnownRun, Training)


def register() -> None:
    bpy.types.Scene.refgs = PointerProperty(type=Training, name="RefGS")


def unregister() -> None:
    del bpy.types.Scene.refgs
