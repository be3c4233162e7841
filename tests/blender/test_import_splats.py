"""Test the import of other programs' splats: they are lit from both sides, and the panel and the exports say what they are not."""

import bpy
import numpy as np
import pytest

from refgs.formats.splats import read_splats, write_display_splats, write_splats
from refgs.formats.spz import write_spz
from refgs_addon.errors import InputError
from refgs_addon.scene.export_run import export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import FOLDER, THEIRS
from tests.makers.blender import attribute, brightness_from_above
from tests.makers.splats import make

WRITERS = {".ply": write_display_splats, ".spz": write_spz, ".SPZ": write_spz}


@pytest.mark.parametrize("ending", WRITERS)
def test_a_file_is_imported(addon, tmp_path, ending):
    file = tmp_path / f"des éclats{ending}"
    splats = make(50)
    WRITERS[ending](file, splats)
    bpy.ops.refgs.import_splats(filepath=str(file))
    (collection,) = addon.collection.children
    assert collection.name == "RefGS des éclats" and collection[THEIRS] and FOLDER not in collection
    (drawn,) = (item for item in collection.objects if item.type == "POINTCLOUD")
    places = attribute(drawn.data, "position")
    x, y, z = splats.positions.T
    np.testing.assert_allclose(
        places, splats.positions if ending == ".ply" else np.stack([x, -z, y], axis=1), atol=1e-6
    )
    assert (attribute(drawn.data, "roughness") == 1).all() and (attribute(drawn.data, "metallic") == 0).all()
    bpy.context.view_layer.objects.active = drawn
    for name in ("splats", "mesh", "light", "display_splats"):
        assert not getattr(bpy.ops.refgs, f"export_{name}").poll()
    with pytest.raises(InputError, match=r"RefGS des éclats is no run: give its splats materials with `refgs export"):
        export_splats(collection, tmp_path / "out.ply")


def test_what_is_no_file_of_splats_is_refused(addon, tmp_path):
    (tmp_path / "a.spz").write_bytes(b"PK\3\4" * 20)
    (tmp_path / "a.splat").write_bytes(b"\0" * 32)
    for name, said in (("a.spz", "is not an SPZ file"), ("a.splat", "is not a folder"), ("b.ply", "is not a folder")):
        with pytest.raises(RuntimeError, match=said):
            bpy.ops.refgs.import_splats(filepath=str(tmp_path / name))
    assert not addon.collection.children


def test_runs_are_not_said_to_be_others(run):
    assert THEIRS not in run.collection and run.collection[FOLDER]


@pytest.mark.parametrize("ours", [False, True])
def test_normals_that_point_away_are_turned_to_the_viewer(tmp_path, scene, ours):
    splats = make(1, 1)
    splats.rotations[:] = 0, 1, 0, 0  # half a turn about x: the shortest axis points down
    splats.normals[:] = 0, 0, -1 if ours else 0
    splats.scales[:], splats.opacities[:], splats.albedo[:], splats.sh[:] = 2.0, 0.999, 0.8, 0.8
    splats.roughness[:], splats.metallic[:] = 1, 0
    (write_splats if ours else write_display_splats)(tmp_path / "a.ply", splats)
    assert (read_splats(tmp_path / "a.ply").normals[0] == (0, 0, -1)).all()
    seen = brightness_from_above(import_run(tmp_path / "a.ply", scene), scene, tmp_path)
    assert seen < 0.1 if ours else seen > 0.3  # RefGS's own splats have a black back
