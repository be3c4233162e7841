"""Test that an imported run casts shadows, whether its mesh or its splats are shown."""

import bpy
import numpy as np
import pytest
from mathutils import Vector

from refgs_addon import compat
from refgs_addon.nodes import add, out
from refgs_addon.nodes.splats_tree import NAME
from refgs_addon.scene.import_run import DEPTH
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import ROOT, show, shown
from tests.makers.runs import read_exr

SIZE = 48


@pytest.fixture
def stage(run, scene):
    """Put a floor under the mesh, a box, and a sun that shines from the side by 45°. Look down on all of it; the splats are invisible."""
    scene.eevee.use_shadows = True
    middle = Vector((1.0, -3.0, 2.0))  # of the box
    scene.world = None
    compat.set_modifier_input(run.splats.modifiers[NAME], "Opacity Cut", 1.0)
    bpy.ops.mesh.primitive_plane_add(size=20, location=middle - Vector((0, 0, 0.5)))
    bpy.context.object.data.materials.append(bpy.data.materials.new("grey"))
    tree = compat.node_tree(bpy.data.materials["grey"])
    grey = add(tree, "ShaderNodeBsdfDiffuse", {"Color": (0.2, 0.2, 0.2, 1)})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(grey)})
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.rotation_euler, sun.data.angle = (0, np.pi / 4, 0), 0
    camera = bpy.data.objects.new("above", bpy.data.cameras.new("above"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.0, middle + Vector((0, 0, 3))
    for item in (sun, camera):
        scene.collection.objects.link(item)
    scene.camera, scene.cycles.samples = camera, 8
    return run


def seen(scene, tmp_path, engine):
    """Return the red radiance at the box, in its shadow half a unit beside it, and on the free floor. A pixel is 2 / SIZE units."""
    render_preview(scene, tmp_path / "a.png", size=SIZE, samples=8, exr=tmp_path / "a.exr", engine=engine)
    row = read_exr(tmp_path / "a.exr")[SIZE // 2, :, 0]
    return [float(row[SIZE // 2 + int(beside * SIZE / 2)]) for beside in (0, -0.5, 0.5)]


@pytest.mark.parametrize("engine", [compat.EEVEE, "CYCLES"])
def test_the_unseen_mesh_casts_the_shadow_of_the_splats(engine, stage, scene, tmp_path):
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    show(stage.collection, "splats")
    box, shadow, floor = seen(scene, tmp_path, engine)
    assert shown(stage.collection) == "splats" and floor > 0.1
    assert box == pytest.approx(floor, rel=0.05) and shadow < 0.1 * floor
    show(stage.collection, "mesh")
    box, shadow, floor = seen(scene, tmp_path, engine)
    assert shown(stage.collection) == "mesh" and box > 2 * floor and shadow < 0.1 * floor


def test_only_the_unseen_mesh_is_drawn_in(run):
    """Check that splats of the surface do not lie in its shadow, and that the mesh that is seen is as large as it was."""

    def size():
        bpy.context.view_layer.update()
        return np.array(run.mesh[0].evaluated_get(bpy.context.evaluated_depsgraph_get()).dimensions)

    whole = size()
    show(run.collection, "splats")
    drawn_in = whole - size()
    assert np.all(drawn_in > DEPTH * run.root[ROOT]) and np.all(drawn_in < 2.01 * DEPTH * run.root[ROOT])
    show(run.collection, "mesh")
    np.testing.assert_allclose(size(), whole, atol=1e-6)
