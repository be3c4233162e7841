"""Test the export of a run's mesh as USD and FBX: Blender's importers read it back, even after it was moved with its textures."""

import shutil
from dataclasses import replace

import bpy
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from refgs.formats.gltf import write_glb
from refgs_addon.errors import InputError
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import export_mesh, export_run
from refgs_addon.scene.import_run import data_blocks, import_run
from refgs_addon.scene.run_parts import show
from tests.makers.blender import principled
from tests.makers.box import textured_box

IMPORTERS = [
    (".usdc", lambda file: bpy.ops.wm.usd_import(filepath=file, import_textures_mode="IMPORT_NONE")),
    (".fbx", lambda file: bpy.ops.import_scene.fbx(filepath=file)),
    (".fbx", lambda file: bpy.ops.wm.fbx_import(filepath=file)),
]


@pytest.fixture
def textured(run_folder):
    mesh, textures = textured_box()
    write_glb(run_folder / "mesh.glb", mesh, textures)
    return run_folder, mesh


@pytest.mark.parametrize(("ending", "read"), IMPORTERS, ids=["usd", "fbx, in Python", "fbx"])
def test_it_comes_back_as_it_was(textured, scene, tmp_path, ending, read):
    folder, mesh = textured
    run = import_run(folder, scene)
    show(run.collection, "splats")
    scene.view_layers[0].objects.active = run.splats
    run.splats.select_set(True)
    before = data_blocks()
    there, moved = tmp_path / "là", tmp_path / "ailleurs, déplacé"
    there.mkdir()
    export_mesh(run.collection, there / f"le pot été{ending}")
    assert data_blocks() == before and not run.mesh[0].visible_camera
    assert bpy.context.view_layer.objects.active == run.splats and run.splats.select_get()
    assert {file.name for file in there.iterdir()} == {f"le pot été{ending}", "le pot été textures"}

    if ending == ".usdc":  # a MaterialX network beside UsdPreviewSurface
        assert b"open_pbr" in (there / "le pot été.usdc").read_bytes()
    shutil.move(there, moved)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    read(str(moved / f"le pot été{ending}"))
    bpy.context.view_layer.update()
    (found,) = (item for item in bpy.data.objects if item.type == "MESH")
    data, turn = found.data, np.array(found.matrix_world.to_3x3())
    assert len(data.polygons) == len(mesh.faces) and np.allclose(turn, np.eye(3), atol=1e-6)
    order = np.array([loop.vertex_index for loop in data.loops])
    places = np.array([found.matrix_world @ vertex.co for vertex in data.vertices])[order]
    normals = np.array([normal.vector for normal in data.corner_normals]) @ turn.T
    corners = np.hstack([places, [loop.uv for loop in data.uv_layers.active.data], normals])
    expected = np.hstack([mesh.vertices, mesh.uv, mesh.normals])
    distance, _ = cKDTree(expected).query(corners)
    assert distance.max() < 1e-3 and cKDTree(corners).query(expected)[0].max() < 1e-3

    (material,) = data.materials
    for name in ("Base Color", "Metallic", "Roughness", "Normal"):
        node = principled(material).inputs[name].links[0].from_node
        if node.type != "TEX_IMAGE":
            assert node.type == {"Normal": "NORMAL_MAP"}.get(name, "SEPARATE_COLOR")
            node = node.inputs["Color"].links[0].from_node
        image, stem = node.image, name.lower().replace(" ", "_")
        assert bpy.path.abspath(image.filepath) == str(moved / "le pot été textures" / f"{stem}.png")
        assert image.colorspace_settings.name == ("sRGB" if name == "Base Color" else "Non-Color")
        shown = np.array(image.pixels).reshape(64, 64, 4)[::-1, :, :3]
        truth = np.asarray(Image.open(folder / "textures" / f"{stem}.png").convert("RGB")) / 255
        np.testing.assert_allclose(shown, truth, atol=1e-6)


def level(item):
    """Read the Specular IOR Level of an object's material."""
    return principled(item.data.materials[0]).inputs["Specular IOR Level"].default_value


@pytest.mark.parametrize("specular", [1.0, 0.0])
def test_what_mirrors_nothing_is_not_given_gloss(run_folder, scene, tmp_path, specular):
    """Check that specular levels 1 and 0 survive an export to FBX and an import.

    The test uses Blender's importer written in Python, because the newer importer does not read the level.
    """
    ending, read = IMPORTERS[1]
    mesh, textures = textured_box()
    write_glb(run_folder / "mesh.glb", mesh, replace(textures, specular=specular))
    run = import_run(run_folder, scene)
    assert level(run.mesh[0]) == pytest.approx(0.5 * specular)
    export_mesh(run.collection, tmp_path / f"pot{ending}")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    read(str(tmp_path / f"pot{ending}"))
    assert level(next(item for item in bpy.data.objects if item.type == "MESH")) == pytest.approx(0.5 * specular)


@pytest.mark.parametrize("ending", [".usdc", ".fbx"])
def test_what_is_in_the_way_is_said_in_one_line(textured, scene, tmp_path, ending):
    folder, _ = textured
    run = import_run(folder, scene)
    before = data_blocks()

    def refused(name, says):
        with pytest.raises(InputError, match=says):
            export_mesh(run.collection, tmp_path / f"{name}{ending}")

    refused("not there/a", r"cannot write .*not there")
    (tmp_path / f"b{ending}").mkdir()
    refused("b", r"cannot write .*b\.")
    (folder / "textures" / "metallic.png").unlink()
    refused("a", r"metallic\.png does not exist: make the run's mesh again")
    (folder / "mesh.glb").unlink()
    refused("a", "make the run's mesh first")
    assert data_blocks() == before
    add_edit(run.collection)
    refused("a", "make the run's mesh first")
    assert not (tmp_path / f"a{ending}").exists()


def test_a_run_that_was_copied_has_its_pictures(textured, scene, tmp_path):
    run = import_run(textured[0], scene)
    export_run(run.collection, tmp_path / "copie")
    copy = import_run(tmp_path / "copie", scene)
    export_mesh(copy.collection, tmp_path / "a.usdc")
    found, source = tmp_path / "a textures", textured[0] / "textures"
    assert len(list(found.iterdir())) == 5
    assert all(file.read_bytes() == (source / file.name).read_bytes() for file in found.iterdir())


@pytest.mark.parametrize("ending", [".usdc", ".fbx"])
def test_engines_get_textures_as_they_pack_them(textured, addon, tmp_path, ending):
    random = np.random.default_rng(0)
    plain = {name: random.integers(0, 256, (64, 64), np.uint8) for name in ("occlusion", "roughness", "metallic")}
    plain["normal"] = random.integers(0, 256, (64, 64, 3), np.uint8)
    for name, pixels in plain.items():
        Image.fromarray(pixels).save(textured[0] / "textures" / f"{name}.png")
    bpy.ops.refgs.import_run(directory=f"{textured[0]}/")
    export = bpy.ops.refgs.export_mesh_usd if ending == ".usdc" else bpy.ops.refgs.export_mesh_fbx
    before = data_blocks()
    for engine in ("Unreal", "Unity"):
        export(filepath=str(tmp_path / f"{engine}{ending}"), engine=engine)
    assert data_blocks() == before

    def texture(engine, name):
        return np.asarray(Image.open(tmp_path / f"{engine} textures" / f"{name}.png"))

    packed = np.dstack([plain["occlusion"], plain["roughness"], plain["metallic"]])
    np.testing.assert_array_equal(texture("Unreal", "occlusion_roughness_metallic"), packed)
    turned = plain["normal"] * [1, -1, 1] + [0, 255, 0]
    np.testing.assert_array_equal(texture("Unreal", "normal_directx"), turned)
    smooth = np.dstack([*[plain["metallic"]] * 3, 255 - plain["roughness"]])
    np.testing.assert_array_equal(texture("Unity", "metallic_smoothness"), smooth)
    assert not (tmp_path / "Unity textures" / "normal_directx.png").exists()


def test_the_file_menu_has_them(textured, addon, tmp_path):
    bpy.ops.refgs.import_run(directory=f"{textured[0]}/")
    bpy.ops.refgs.export_mesh_usd(filepath=str(tmp_path / "a.usdc"))
    bpy.ops.refgs.export_mesh_fbx(filepath=str(tmp_path / "a.fbx"))
    assert (tmp_path / "a.usdc").stat().st_size and (tmp_path / "a.fbx").stat().st_size
