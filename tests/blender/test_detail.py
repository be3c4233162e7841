"""Test levels of detail: how much of a run they leave, and that it covers the same."""

import bpy
import numpy as np
import pytest

from refgs.formats.gltf import write_glb
from refgs_addon.scene.detail import LEVELS, detail, set_detail
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import show
from tests.makers.blender import drawn, drawn_axes
from tests.makers.box import textured_box
from tests.makers.runs import random_columns, write_ply


def areas(run):
    """Return the areas of the splats that are drawn, by their roughness, which tells them apart."""
    sides = np.linalg.norm(drawn_axes(run.splats)[1], axis=2)
    return dict(zip(drawn(run.splats, "roughness").tolist(), sides.prod(axis=1).tolist(), strict=True))


def test_fewer_splats_cover_as_much(run_folder, scene):
    write_ply(run_folder / "splats.ply", random_columns(4000))
    run = import_run(run_folder, scene)
    show(run.collection, "splats")
    whole = areas(run)
    for level in LEVELS[1:]:
        set_detail(run.collection, level)
        some = areas(run)
        assert len(some) == pytest.approx(4000 * level, rel=0.15) and detail(run.collection) == pytest.approx(level)
        assert all(area == pytest.approx(whole[name] / level, rel=1e-3) for name, area in some.items())
        assert sum(some.values()) == pytest.approx(sum(whole.values()), rel=0.3)
    set_detail(run.collection, 1.0)
    assert areas(run) == whole


def test_a_simplified_mesh_has_no_cracks(run_folder, scene):
    """Check a mesh whose vertices the file doubles at the seams of its texture."""
    mesh, textures = textured_box()
    write_glb(run_folder / "mesh.glb", mesh, textures)
    run = import_run(run_folder, scene)
    item = run.mesh[0]
    modifier = item.modifiers.new("fine", "SUBSURF")
    modifier.subdivision_type, modifier.levels = "SIMPLE", 3
    set_detail(run.collection, 0.25)
    item.modifiers.move(item.modifiers.find("fine"), 0)

    def counted():
        """Return the number of triangles, and how many faces share each edge."""
        bpy.context.view_layer.update()
        faces = item.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.polygons
        keys = [key for face in faces for key in face.edge_keys]
        return sum(len(face.vertices) - 2 for face in faces), np.unique(keys, axis=0, return_counts=True)[1]

    some, shared = counted()
    assert np.all(shared == 2)
    set_detail(run.collection, 1.0)
    whole, shared = counted()
    assert np.all(shared == 2) and some == pytest.approx(whole / 4, rel=0.05)
