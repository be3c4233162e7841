"""Test the extension with OpenColorIO configs of studios: other names of colour spaces, and ACEScg as the working space.

Blender reads a config when it starts, so each is tested in a process of its own.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from refgs.color import srgb_decode
from refgs.formats.gltf import write_glb
from refgs_addon.scene.color_spaces import from_rec709, to_rec709
from tests.makers.blender import attribute
from tests.makers.box import textured_box
from tests.makers.runs import COLUMNS, write_panorama, write_ply

ROOT = Path(__file__).resolve().parents[2]
TO_ACESCG = np.array([[0.61310, 0.33952, 0.04738], [0.07019, 0.91635, 0.01345], [0.02062, 0.10957, 0.86981]])
COLOR = np.array([0.8, 0.4, 0.2])

CONFIG = """ocio_profile_version: 2
strictparsing: true
roles:
  reference: ACEScg
  scene_linear: ACEScg
  rendering: ACEScg
  default: ACEScg
  default_float: ACEScg
  {role}
  data: Raw
  color_timing: ACEScg
  compositing_log: ACEScg
  color_picking: {srgb}
  texture_paint: {srgb}
  matte_paint: {srgb}
displays:
  {display}:
    - !<View> {{name: Raw, colorspace: Raw}}
    - !<View> {{name: {view}, colorspace: {srgb}}}
active_displays: [{display}]
active_views: [Raw, {view}]
colorspaces:
  - !<ColorSpace>
    name: ACEScg
  - !<ColorSpace>
    name: ACES2065-1
    to_scene_reference: !<BuiltinTransform> {{style: ACEScg_to_ACES2065-1, direction: inverse}}
  - !<ColorSpace>
    name: {linear}
    to_scene_reference: !<MatrixTransform> {{matrix: {matrix}}}
  - !<ColorSpace>
    name: {srgb}
    to_scene_reference: !<GroupTransform>
      children:
        - !<ExponentWithLinearTransform> {{gamma: 2.4, offset: 0.055}}
        - !<MatrixTransform> {{matrix: {matrix}}}
  - !<ColorSpace>
    name: Raw
    isdata: true
"""

PROGRAM = """
import json, sys
from pathlib import Path
import bpy
from refgs_addon.scene.color_spaces import set_srgb_view
from refgs_addon.scene.export_run import export_mesh
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.mesh_exchange import _material
from refgs_addon.scene.render_eevee import render_preview
from tests.makers.blender import principled

folder, out = map(Path, sys.argv[1:])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
run = import_run(folder, scene)
light = run.world["refgs_recovered"]
says = {"known": run.light_is_rec709, "light": list(light.pixels[:3])}
for ending in (".usdc", ".fbx"):
    export_mesh(run.collection, out / f"pot{ending}", "Unreal")
material = _material("pot", folder / "textures", 1.0)
images = {node.image.name: node.image for node in material.node_tree.nodes if node.type == "TEX_IMAGE"}
says["spaces"] = {name: image.colorspace_settings.name for name, image in images.items()}
says["data"] = {name: image.colorspace_settings.is_data for name, image in images.items()}
scene.cycles.samples = 1
scene.cycles.use_denoising = False
before = scene.display_settings.display_device, scene.view_settings.view_transform
render_preview(scene, out / "view.png", size=32, engine="CYCLES")
says["restored"] = before == (scene.display_settings.display_device, scene.view_settings.view_transform)
set_srgb_view(scene)
says["view"] = [scene.display_settings.display_device, scene.view_settings.view_transform]
print("SAYS " + json.dumps(says))
"""


# Imports runs of one colour each, and measures that colour as Blender has it and as it comes back.
COLORS_PROGRAM = """
import json, sys
from pathlib import Path
import bpy
from refgs_addon import compat
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import edited_materials, export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.material_presets import save_material
from refgs_addon.scene.panorama import best_rotation
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.world_light import load_panorama
from tests.makers.blender import attribute, principled

out = Path(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
if sys.argv[2] == "file":
    bpy.ops.wm.set_working_color_space(working_space="ACEScg")
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 4, False
scene.render.resolution_x = scene.render.resolution_y = 9
scene.render.film_transparent = True
compat.set_format(scene.render.image_settings, "OPEN_EXR", "32")
camera = scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler = (0, -20, 3), (1.5707963, 0, 0)
camera.data.type, camera.data.ortho_scale = "ORTHO", 0.5

def rendered(run, part):
    show(run.collection, part)
    scene.render.filepath = str(out / f"{part}.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    r, g, b, alpha = image.pixels[4 * 40 : 4 * 41]
    bpy.data.images.remove(image)
    return [r / alpha, g / alpha, b / alpha]

says = {}
for name in ("grey", "gold", "red"):
    run = import_run(out / name, scene)
    scene.world.cycles.sampling_method = "NONE"  # no noise under a uniform light
    principled(run.splats.data.materials[0]).inputs["Specular IOR Level"].default_value = 0
    says[name] = {part: rendered(run, part) for part in ("splats", "mesh")}
    says[name]["stored"] = attribute(run.splats.data, "base_color")[0].tolist()
    export_splats(run.collection, out / f"{name}.ply")
    if name != "red":
        for item in (run.splats, *run.mesh):
            item.hide_render = True
edit = add_edit(run.collection, material="Gold")
says["edit"] = list(compat.get_modifier_input(edit, "Base Color"))
says["edited"] = edited_materials(run.splats)["base_color"][0].tolist()
says["preset"] = save_material(edit, "Mine").read_text()
says["default"] = list(edit.node_group.interface.items_tree["Base Color"].default_value)
mixes = [node for node in run.splats.modifiers["RefGS Splats"].node_group.nodes if node.type == "MIX"]
says["doubt"] = [list(next(s for s in node.inputs if s.name == "A" and s.enabled).default_value) for node in mixes]
compat.set_modifier_input(edit, "Base Color", (0.0, 1.0, 0.0, 1.0))
says["green"] = edited_materials(run.splats)["base_color"][0].tolist()
colored = load_panorama(out / "colored.exr")
colored.colorspace_settings.name = run.world["refgs_recovered"].colorspace_settings.name
says["brighter"] = best_rotation(run.world["refgs_recovered"], colored)[1]
print("SAYS " + json.dumps(says))
"""


def in_studio(folder: Path, tmp_path: Path, **names: str) -> dict:
    """Run PROGRAM with a config whose spaces have these names. Returns what it says."""
    return in_blender(PROGRAM, [folder, tmp_path], write_config(tmp_path, **names))


def write_config(tmp_path: Path, **names: str) -> str:
    """Write a config whose spaces have these names. Returns its path."""
    matrix = np.eye(4)
    matrix[:3, :3] = TO_ACESCG
    names = {"matrix": matrix.ravel().tolist(), "role": "", **names}
    (tmp_path / "config.ocio").write_text(CONFIG.format(**names))
    return str(tmp_path / "config.ocio")


def in_blender(program: str, arguments: list[Path | str], config: str) -> dict:
    """Run a program in a Blender with an OpenColorIO config: a path, the URI of one in OpenColorIO, or "". Returns what it says."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "OCIO": config},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("SAYS "))[5:])


@pytest.fixture
def colored(run_folder):
    """Write a run whose light has one colour, and whose mesh has textures."""
    write_panorama(run_folder / "environment.exr", np.full((16, 32, 3), COLOR))
    write_glb(run_folder / "mesh.glb", *textured_box())
    return run_folder


@pytest.mark.parametrize(
    ("linear", "srgb", "display", "view"),
    [
        ("Linear Rec.709 (sRGB)", "sRGB - Texture", "sRGB - Display", "Un-tone-mapped"),  # ACES 1.3
        ("Linear Rec.709 (sRGB)", "sRGB Encoded Rec.709 (sRGB)", "sRGB - Display", "Un-tone-mapped"),  # ACES 2
        ("Utility - Linear - sRGB", "Utility - sRGB - Texture", "ACES", "sRGB"),  # ACES 1.2
        ("lin_rec709", "srgb_texture", "sRGB", "Standard"),
    ],
    ids=["ACES 1.3", "ACES 2", "ACES 1.2", "own"],
)
def test_spaces_are_found_in_a_studios_config(colored, tmp_path, linear, srgb, display, view):
    """Check that the light is read as linear Rec.709, and textures as sRGB and data; that nothing raises; that nothing else changes."""
    said = in_studio(colored, tmp_path, linear=linear, srgb=srgb, display=display, view=view)
    assert said["known"] and said["restored"]
    np.testing.assert_allclose(said["light"], TO_ACESCG @ COLOR, rtol=2e-3)
    assert said["spaces"].pop("base_color.png") == srgb and not said["data"].pop("base_color.png")
    assert {*said["spaces"].values()} == {"Raw"} and all(said["data"].values())
    assert said["view"] == [display, view if view != "sRGB" else "Raw"]  # ACES 1.2 maps tones in its view sRGB
    assert (tmp_path / "view.png").is_file()


def test_a_config_without_known_names_is_told(colored, tmp_path):
    """Check that the import and the exports work with the config's defaults, and that the import says so."""
    names = {"linear": "Studio 709", "srgb": "Studio Byte", "display": "Studio", "view": "Film"}
    said = in_studio(colored, tmp_path, **names, role="default_byte: Studio Byte")
    assert not said["known"] and said["spaces"]["base_color.png"] == "Studio Byte"
    np.testing.assert_allclose(said["light"], COLOR, rtol=2e-3)


# Colours that 8-bit textures hold exactly, as linear Rec.709.
COLORS = {name: srgb_decode(np.array(rgb) / 255) for name, rgb in (
    ("grey", (128, 128, 128)), ("gold", (255, 226, 157)), ("red", (230, 10, 5)),
)}  # fmt: skip


@pytest.fixture
def of_one_color(tmp_path, monkeypatch):
    """Write a run for each of COLORS: one matte splat in front of a matte box of the same colour, in a white light. Returns the folder."""
    monkeypatch.setenv("BLENDER_USER_SCRIPTS", str(tmp_path / "scripts"))
    (tmp_path / "scripts").mkdir()
    mesh, textures = textured_box()
    for name, color in COLORS.items():
        (tmp_path / name).mkdir()
        values = {column: [0.0] for column in COLUMNS} | {"y": [-2.2], "z": [3.0], "ny": [-1.0], "opacity": [20.0]}
        values |= {"rot_0": [0.5**0.5], "rot_1": [0.5**0.5], "roughness": [1.0]}
        values |= {f"albedo_{channel}": [value] for channel, value in zip("rgb", color, strict=True)}
        write_ply(tmp_path / name / "splats.ply", values)
        one = np.ones_like(textures.roughness)
        flat = {"metallic": 0 * one, "roughness": one, "occlusion": one, "normal": textures.normal * 0 + [0, 0, 1]}
        matte = replace(textures, base_color=textures.base_color * 0 + color, specular=0.0, **flat)
        write_glb(tmp_path / name / "mesh.glb", mesh, matte)
        write_panorama(tmp_path / name / "environment.exr", np.ones((16, 32, 3)))
    write_panorama(tmp_path / "colored.exr", np.full((16, 32, 3), COLOR))
    return tmp_path


ACES_1_3 = "ocio://cg-config-v1.0.0_aces-v1.3_ocio-v2.1"  # its 8-bit pictures are ACEScct by default
ACES_1_2 = {"linear": "Utility - Linear - sRGB", "srgb": "Utility - sRGB - Texture", "display": "ACES", "view": "sRGB"}
UNKNOWN = {
    "linear": "Studio 709",
    "srgb": "sRGB",
    "display": "sRGB",
    "view": "Standard",
    "role": "aces_interchange: ACES2065-1",
}


@pytest.mark.parametrize(
    "kind",
    [
        "ACES 1.3",
        "ACES 1.2",  # without interchange roles
        "unknown names",  # with an interchange role
        pytest.param("file", marks=pytest.mark.skipif(bpy.app.version < (5, 0, 0), reason="since Blender 5.0")),
        "Blender's",
    ],
)
def test_colors_are_those_of_the_working_space(of_one_color, tmp_path, kind):
    """Check renderings of splats and of meshes, edits, presets and exports against ACEScg. `kind` is how that became the working space."""
    config = {"ACES 1.3": ACES_1_3, "file": "", "Blender's": ""}.get(kind)
    if config is None:
        config = write_config(tmp_path, **(ACES_1_2 if kind == "ACES 1.2" else UNKNOWN))
    said = in_blender(COLORS_PROGRAM, [tmp_path, kind], config)
    matrix = np.eye(3) if kind == "Blender's" else TO_ACESCG
    gold = np.array([1.0, 0.766, 0.336])
    for name, color in COLORS.items():
        for seen in ("stored", "splats", "mesh"):
            np.testing.assert_allclose(said[name][seen][:3], matrix @ color, atol=1e-3, err_msg=f"{name}, {seen}")
        assert said[name]["stored"][3] == 1.0
        before, after = ((tmp_path / file).read_bytes() for file in (f"{name}/splats.ply", f"{name}.ply"))
        if kind == "Blender's":
            assert np.float32(said[name]["stored"][:3]).tolist() == np.float32(color).tolist()
            assert after.endswith(before.split(b"end_header")[1])
        np.testing.assert_allclose(np.frombuffer(after[-84:], "<f4"), np.frombuffer(before[-84:], "<f4"), atol=1e-6)
    np.testing.assert_allclose(said["edit"], [*matrix @ gold, 1], atol=1e-3)
    np.testing.assert_allclose(said["default"], [*matrix @ [1, 0.77, 0.34], 1], atol=1e-3)
    np.testing.assert_allclose(said["edited"], gold, atol=2e-6)
    assert "base_color = (1.0, 0.766, 0.336, 1.0)\n" in said["preset"]
    np.testing.assert_allclose(said["doubt"], [[*matrix @ [0.089, 0.1, 0.119], 1]], atol=1e-3)
    assert said["green"] == [0, 1, 0]  # ACEScg's green has negative red in Rec.709
    if kind != "unknown names":  # the light's space is unknown, too
        np.testing.assert_allclose(said["brighter"], COLOR @ [0.2126, 0.7152, 0.0722], rtol=2e-3)


def test_blenders_own_config_changes_no_bit(run):
    """Check that colours pass untouched where the working space is linear Rec.709."""
    color = attribute(run.splats.data, "base_color")
    assert from_rec709(color) is color and to_rec709(color) is color
    assert from_rec709((1.0, 0.77, 0.34, 1.0)) == (1.0, 0.77, 0.34, 1.0)
