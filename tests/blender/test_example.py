"""Test the example that comes with the extension: it is imported as any run, can be edited and relit, and is never written to."""

from types import SimpleNamespace
from unittest.mock import Mock

import bpy
import pytest

from refgs.run_folder import check_finished
from refgs_addon.errors import InputError
from refgs_addon.nodes.panorama_world import RECOVERED
from refgs_addon.scene.export_run import export_mesh, export_run
from refgs_addon.scene.run_parts import EXAMPLE, FOLDER, active_run, cameras, folder_of, parts, shown
from refgs_addon.scene.world_light import hdris, relight
from refgs_addon.trainer.scene import training
from refgs_addon.ui import export_menu, menus

LARGEST = 300_000  # bytes


@pytest.fixture
def example(addon):
    """Import the example by its button. Returns the run's collection."""
    before = contents()
    assert bpy.ops.refgs.import_example() == {"FINISHED"}
    yield active_run(bpy.context)
    assert contents() == before


def contents():
    return {file.relative_to(EXAMPLE): file.read_bytes() for file in EXAMPLE.rglob("*") if file.is_file()}


def test_one_click_brings_a_mesh_with_textures_splats_cameras_and_the_light(example, addon):
    found = parts(example)
    mesh = found["mesh"][0]
    assert shown(example) == "mesh" and len(mesh.data.polygons) > 2000 and len(found["splats"][0].data.points) > 1500
    pictures = [
        node.image for node in mesh.data.materials[0].node_tree.nodes if node.type == "TEX_IMAGE" and node.image
    ]
    assert len({tuple(picture.size) for picture in pictures}) == 1 and min(pictures[0].size) >= 256
    assert addon.world[RECOVERED].packed_file and len(cameras(example).all_objects) > 4
    assert bpy.ops.refgs.next_camera() == {"FINISHED"} and not bpy.ops.refgs.photo.poll()  # the photos stayed at home
    with pytest.raises(InputError, match="the example came without its photos"):
        training.plan_hint(addon, example)


def test_it_is_edited_relit_and_exported_elsewhere(example, addon, tmp_path):
    assert bpy.ops.refgs.add_edit(where="Sphere", material="Gold") == {"FINISHED"}
    relight(addon, hdris()[0])
    assert bpy.ops.refgs.match_light() == {"FINISHED"}
    for name in ("splats", "mesh", "mesh_usd", "mesh_fbx", "light"):
        operator = getattr(bpy.ops.refgs, f"export_{name}")
        assert operator.poll() and operator(filepath=str(tmp_path / f"a{EXTENSIONS[name]}")) == {"FINISHED"}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    export_run(example, tmp_path / "gold")
    check_finished(tmp_path / "gold")
    export_mesh(example, tmp_path / "b.glb")
    assert (tmp_path / "gold" / "mesh.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


EXTENSIONS = {"splats": ".ply", "mesh": ".glb", "mesh_usd": ".usdc", "mesh_fbx": ".fbx", "light": ".exr"}


def test_exports_are_not_offered_a_place_in_the_extension(example, tmp_path, monkeypatch):
    monkeypatch.setattr(export_menu.Path, "home", lambda: tmp_path)
    assert proposed(export_menu.ExportMesh) == tmp_path / "jar mesh.glb"
    (tmp_path / "project").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "project" / "a.blend"))
    assert proposed(export_menu.ExportSplats) == tmp_path / "project" / "jar splats.ply"
    example[FOLDER] = str(tmp_path / "runs" / "pot")
    assert proposed(export_menu.ApplyEdits) == tmp_path / "runs" / "pot edited"


def proposed(kind):
    """Return the path that an export proposes when its file browser opens."""
    operator = Mock(kind=kind.kind, filename_ext=kind.filename_ext)
    context = SimpleNamespace(
        scene=bpy.context.scene, view_layer=bpy.context.view_layer, window_manager=Mock(spec=["fileselect_add"])
    )
    kind.invoke(operator, context, None)
    return export_menu.Path(operator.filepath)


@pytest.mark.parametrize("where", ["/home/else/refgs", r"C:\Users\else\refgs", "//../else/refgs"])
def test_a_blend_from_elsewhere_finds_the_example_of_this_extension(example, tmp_path, where):
    file, name = tmp_path / "a.blend", example.name
    sep = "\\" if "\\" in where else "/"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    example[FOLDER] = sep.join((where, *EXAMPLE.parts[-3:]))
    assert folder_of(example) is None
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(file))
    assert folder_of(bpy.data.collections[name]) == EXAMPLE


def test_it_is_small_and_names_no_folder_of_who_made_it():
    assert sum(map(len, contents().values())) <= LARGEST
    text = (EXAMPLE / "run.toml").read_text(encoding="utf-8") + (EXAMPLE / "cameras.json").read_text(encoding="utf-8")
    assert 'capture = ""' in text and "/root" not in text and "/home" not in text and "/tmp" not in text
    check_finished(EXAMPLE)


def test_the_add_menu_has_it():
    entries = []
    layout = SimpleNamespace(operator=lambda name, **_: entries.append(name))
    menus._add_menu(SimpleNamespace(layout=layout), bpy.context)
    assert entries == ["refgs.import_run", "refgs.import_example"]
