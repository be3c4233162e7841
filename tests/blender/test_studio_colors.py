"""Test the extension with OpenColorIO configs of studios: other names of colour spaces, and ACEScg as the working space.

Blender reads a config when it starts, so each is tested in a process of its own.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from refgs.formats.gltf import write_glb
from tests.makers.box import textured_box
from tests.makers.runs import write_panorama

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
  {byte}
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


def in_studio(folder: Path, tmp_path: Path, **names: str) -> dict:
    """Run PROGRAM with a config whose spaces have these names. Returns what it says."""
    matrix = np.eye(4)
    matrix[:3, :3] = TO_ACESCG
    names = {"matrix": matrix.ravel().tolist(), "byte": "", **names}
    (tmp_path / "config.ocio").write_text(CONFIG.format(**names))
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder), str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "OCIO": str(tmp_path / "config.ocio")},
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
    said = in_studio(colored, tmp_path, **names, byte="default_byte: Studio Byte")
    assert not said["known"] and said["spaces"]["base_color.png"] == "Studio Byte"
    np.testing.assert_allclose(said["light"], COLOR, rtol=2e-3)
