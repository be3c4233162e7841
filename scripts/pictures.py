"""Draw the README's pictures in Blender: `python scripts/pictures.py demo/run` writes them to docs/pictures.

Each shows the run's mesh from a held-out camera: under the recovered light, under another light, made of gold, and on a table in the sun.
"""

import math
import sys
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from refgs_addon.scene.edit import add_edit, remove_edit  # noqa: E402
from refgs_addon.scene.import_run import import_run  # noqa: E402
from refgs_addon.scene.render_eevee import render_preview  # noqa: E402
from refgs_addon.scene.run_parts import ROOT as SIDE  # noqa: E402
from refgs_addon.scene.world_light import hdris, relight  # noqa: E402

SIZE = 256  # pixels
VIEW = "test_004"  # which docs/pictures/photo.png shows
PICTURES = ROOT / "docs" / "pictures"


def main(folder: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    run = import_run(folder, scene)
    scene.camera = run.cameras[VIEW]
    studio, sunset = (next(file for file in hdris() if file.stem == name) for name in ("studio", "sunset"))
    draw(scene, "recovered")
    relight(scene, sunset)
    draw(scene, "relit")
    edit = add_edit(run.collection, material="Gold")
    draw(scene, "gold")
    remove_edit(run.splats, edit.name)
    relight(scene, studio, strength=0.4)
    side = run.root[SIDE]
    bpy.ops.mesh.primitive_plane_add(size=30 * side, location=run.root.location)
    table = bpy.data.materials.new("table")
    table.use_nodes = True
    table.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.2, 0.08, 0.03, 1)
    table.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.2
    bpy.context.object.data.materials.append(table)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle = 4.0, 0.05
    sun.rotation_euler = (math.radians(45), 0, scene.camera.matrix_world.to_euler().z + math.radians(60))
    scene.collection.objects.link(sun)
    scene.cycles.samples = 256
    draw(scene, "table", engine="CYCLES")


def draw(scene: bpy.types.Scene, name: str, **how) -> None:
    render_preview(scene, PICTURES / f"{name}.png", size=SIZE, **how)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
