"""Export a run's mesh as USD or FBX through Blender's own exporters, with its textures beside it."""

import os
import shutil
import tempfile
from pathlib import Path

import bpy

from ..compat import NO_FBX, NO_USD, node_tree, usd_materials
from ..errors import InputError
from ..nodes import add, out, principled
from ..nodes.splat_material import SPECULAR
from .atomic_file import unwritable
from .color_spaces import SRGB, set_color_space
from .glb_pictures import unpack_pictures
from .import_run import add_mesh, data_blocks

TEXTURES = "textures"  # folder beside a run's mesh.glb
_PICTURES = {"base_color": "Base Color", "metallic": "Metallic", "roughness": "Roughness", "normal": "Normal"}


# Textures that a game engine wants beside the separate ones: its channels, each a texture's, turned over (1 - value) after "-".
PACKED = {
    "Any Program": {},
    "Unreal": {
        "occlusion_roughness_metallic": (("occlusion", 0), ("roughness", 0), ("metallic", 0)),
        "normal_directx": (("normal", 0), ("-normal", 1), ("normal", 2)),
    },
    "Unity": {"metallic_smoothness": (("metallic", 0), ("metallic", 0), ("metallic", 0), ("-roughness", 0))},
}


def write_mesh(mesh: Path, path: Path, engine: str = "Any Program") -> None:
    """Convert a run's mesh.glb to the .usdc or .fbx file `path`. Copy the run's textures to the folder `NAME textures` beside that file.

    `engine` is the game engine for which extra textures are written to the same folder: "Unreal", "Unity", or "Any Program" for none. The
    open .blend does not change. Raises InputError if a texture is missing, or if a file cannot be read or written.
    """
    before = data_blocks()
    try:
        # All is made in a folder of its own: with MaterialX, Blender leaves a second copy of the textures beside the file.
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as work:
            made, folder = Path(work, path.name), Path(work, f"{path.stem} {TEXTURES}")
            folder.mkdir()
            for name, source in textures_of(mesh, Path(work, "inside")).items():
                shutil.copyfile(source, folder / f"{name}.png")
            for name, channels in PACKED[engine].items():
                _pack(folder / f"{name}.png", folder, channels)
            # A scene of its own: the export ignores what is selected or hidden elsewhere.
            scene = bpy.data.scenes.new(path.stem)
            with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
                items = add_mesh(mesh, path.stem, scene.collection)
                material = _material(path.stem, folder, _specular(items[0]))
                for item in items:
                    item.data.materials.clear()
                    item.data.materials.append(material)
                _EXPORTERS[path.suffix.lower()](str(made))
            target = path.with_name(folder.name)
            target.mkdir(exist_ok=True)
            for file in folder.iterdir():
                os.replace(file, target / file.name)
            os.replace(made, path)
    except (RuntimeError, OSError) as error:
        raise unwritable(path, error) from None
    finally:
        bpy.data.batch_remove(data_blocks() - before)


def textures_of(mesh: Path, folder: Path) -> dict[str, Path]:
    """Return a run's PNG textures by name: those beside its mesh.glb, or else those inside it, which are written into the new `folder`.

    Raises InputError if the folder beside the mesh lacks one, or the mesh has none.
    """
    if not (mesh.parent / TEXTURES).is_dir():
        return unpack_pictures(mesh, folder)
    files = {name: mesh.parent / TEXTURES / f"{name}.png" for name in (*_PICTURES, "occlusion")}
    for file in files.values():
        if not file.is_file():
            raise InputError(f"{file} does not exist: make the run's mesh again")
    return files


def _specular(item: bpy.types.Object) -> float:
    """Return the Specular IOR Level of an imported mesh's material."""
    return principled(item.data.materials[0]).inputs[SPECULAR].default_value


def _material(name: str, folder: Path, specular: float) -> bpy.types.Material:
    """Make a Principled BSDF material that reads each input from its own texture."""
    material = bpy.data.materials.new(name)
    tree, inputs = node_tree(material), {SPECULAR: specular}
    for picture, socket in _PICTURES.items():
        image = bpy.data.images.load(str(folder / f"{picture}.png"))
        if picture == "base_color":
            set_color_space(image, SRGB)  # else the config's default for pictures of 8 bits
        else:
            image.colorspace_settings.is_data = True
        inputs[socket] = out(add(tree, "ShaderNodeTexImage", image=image))
    inputs["Normal"] = out(add(tree, "ShaderNodeNormalMap", {"Color": inputs["Normal"]}))
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(add(tree, "ShaderNodeBsdfPrincipled", inputs))})
    return material


def _pack(path: Path, folder: Path, channels: tuple[tuple[str, int], ...]) -> None:
    """Write a PNG from (texture, channel index) pairs, inverted if the name begins with "-"."""
    import numpy as np  # Debian's Blender may lack it

    from .pictures import read_png, write_png

    found = []
    for name, channel in channels:
        values = read_png(folder / f"{name.removeprefix('-')}.png")[..., channel]
        found.append(1 - values if name.startswith("-") else values)
    write_png(path, np.stack(found, axis=2))


def _usd(file: str) -> None:
    try:
        materials = usd_materials()
    except KeyError:
        raise InputError(NO_USD) from None
    bpy.ops.wm.usd_export(filepath=file, export_custom_properties=False, convert_world_material=False, **materials)


def _fbx(file: str) -> None:
    try:
        bpy.ops.export_scene.fbx(filepath=file, path_mode="RELATIVE", use_tspace=True, bake_anim=False)
    except AttributeError:  # the operator does not exist
        raise InputError(NO_FBX) from None


_EXPORTERS = {".usdc": _usd, ".fbx": _fbx}
