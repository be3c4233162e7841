"""Test that the mesh of an edited run is exported with its edits, without the trainer."""

import io

import addon_utils
import bpy
import numpy as np
import pytest
import trimesh
from PIL import Image

from refgs.color import srgb_decode, srgb_encode
from refgs.formats.gltf import write_glb
from refgs_addon import compat, jobs
from refgs_addon.errors import InputError
from refgs_addon.nodes.edit_tree import AMOUNT, COLOR, SURFACE
from refgs_addon.scene.bake_edits import bake_edits
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import export_mesh, export_run
from refgs_addon.scene.import_run import data_blocks, import_run
from refgs_addon.scene.run_parts import show
from refgs_addon.trainer import preferences
from tests.makers.blender import attribute
from tests.makers.box import SIZE, glb_chunks, rewrite_glb, textured_box
from tests.makers.runs import random_columns, write_ply

COUNT = 4000
ENDINGS = (".glb", ".usdc", ".fbx")
EDITED = ("base_color", "metallic", "roughness")


@pytest.fixture
def box(run_folder, scene):
    """Import a run whose splats lie on the surface of a textured box. Returns the run and the box's mesh."""
    mesh, textures = textured_box()
    write_glb(run_folder / "mesh.glb", mesh, textures)
    places = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), COUNT, seed=0)[0]
    columns = random_columns(COUNT) | dict(zip("xyz", places.T, strict=True)) | {"opacity": np.full(COUNT, 5.0)}
    write_ply(run_folder / "splats.ply", columns)
    return import_run(run_folder, scene), mesh


def textures(folder):
    return {name: np.asarray(Image.open(folder / f"{name}.png").convert("RGB")) for name in (*EDITED, "occlusion")}


def pictures(file):
    """Read the pictures in a binary glTF file: base colour; occlusion, roughness and metallic; normals."""
    tree, buffer = glb_chunks(file)
    material = tree["materials"][0]
    found = []
    for key in (
        material["pbrMetallicRoughness"]["baseColorTexture"],
        material["pbrMetallicRoughness"]["metallicRoughnessTexture"],
        material["normalTexture"],
    ):
        view = tree["bufferViews"][tree["images"][tree["textures"][key["index"]]["source"]]["bufferView"]]
        data = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        found.append(np.asarray(Image.open(io.BytesIO(data))))
    return found


def upper_half(run):
    """Make the upper half of the box gold, with a sharp border."""
    edit = add_edit(run.collection, "Box", "Gold")
    region = next(item for item in run.collection.objects if item.name.startswith("Box of"))
    region.parent = None
    region.location, region.scale = (0.0, 0.0, 8.0), (5.0, 5.0, 5.0)
    return edit


@pytest.mark.parametrize("part", ["splats", "mesh"])
def test_a_glb_has_the_edits_and_the_rest_as_it_was(box, run_folder, tmp_path, part):
    run, mesh = box
    upper_half(run)
    show(run.collection, part)
    before, blocks = textures(run_folder / "textures"), data_blocks()
    export_mesh(run.collection, tmp_path / "a.glb")
    assert data_blocks() == blocks and [file.name for file in tmp_path.iterdir()].count("a.glb") == 1
    color, packed, normal = pictures(tmp_path / "a.glb")
    np.testing.assert_array_equal(normal, pictures(run_folder / "mesh.glb")[2])
    old, new = (
        trimesh.load(file, force="mesh", process=False) for file in (run_folder / "mesh.glb", tmp_path / "a.glb")
    )
    np.testing.assert_array_equal(new.vertices, old.vertices)
    np.testing.assert_array_equal(new.faces, old.faces)
    np.testing.assert_array_equal(new.visual.uv, old.visual.uv)

    at = (mesh.uv * SIZE).astype(int).clip(0, SIZE - 1)
    column, row = at[:, 0], SIZE - 1 - at[:, 1]
    above, below = mesh.vertices[:, 2] > 5, mesh.vertices[:, 2] < 1
    gold = np.rint(255 * srgb_encode(np.array([1.0, 0.766, 0.336])))
    assert above.any() and below.any()
    # The next vertices, half the box away, are not gold: a texel near one has a little of theirs.
    np.testing.assert_allclose(color[row[above], column[above]], np.tile(gold, (above.sum(), 1)), atol=8)
    np.testing.assert_allclose(packed[row[above], column[above]], np.tile([230, 38, 255], (above.sum(), 1)), atol=8)
    np.testing.assert_array_equal(color[row[below], column[below]], before["base_color"][row[below], column[below]])
    np.testing.assert_array_equal(
        packed[row[below], column[below], 2], before["metallic"][row[below], column[below], 0]
    )


def test_the_textures_have_what_the_mesh_shows(box, run_folder, tmp_path):
    """Compare the texels at the vertices with the attributes that the modifier gives to the mesh in Blender."""
    run, mesh = box
    edit = upper_half(run)
    for name, value in (("Falloff", 1.0), ("Color Amount", 0.7)):
        compat.set_modifier_input(edit, name, value)
    bake_edits(run.collection, run_folder / "mesh.glb", tmp_path)
    bpy.context.view_layer.update()
    shown = run.mesh[0].evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    amount, color, surface = (attribute(shown, name) for name in (AMOUNT, COLOR, SURFACE))
    assert ((amount[:, 0] > 0.1) & (amount[:, 0] < 0.6)).any()
    before, after = textures(run_folder / "textures"), textures(tmp_path / "textures")
    places = np.array([vertex.co for vertex in shown.vertices]).round(4)
    corner = {tuple(place): i for i, place in enumerate(places)}
    vertex = np.array([corner[tuple(place)] for place in mesh.vertices.round(4)])
    texel = mesh.uv * SIZE - 0.5
    near = np.abs(texel - texel.round()).max(axis=1) < 0.5
    column, row = texel.round().astype(int)[near].clip(0, SIZE - 1).T
    row, vertex = SIZE - 1 - row, vertex[near]
    a = amount[vertex]
    learned = srgb_decode(before["base_color"][row, column] / 255)
    expected = 255 * srgb_encode((learned * (1 - a[:, :1]) + color[vertex]).clip(0, 1))
    assert (
        np.abs(after["base_color"][row, column] - expected).mean() < 6
    )  # of 255: texels are not quite at the vertices
    for name, i in (("metallic", 0), ("roughness", 1)):
        expected = before[name][row, column, 0] * (1 - a[:, 1 + i]) + 255 * surface[vertex, i]
        assert np.abs(after[name][row, column, 0] - expected).mean() < 6


def test_texels_around_charts_are_edited(box, run_folder, tmp_path):
    """Check the texels that a bilinear look-up reads at the border of a chart. Their centres may lie outside of it."""
    run, mesh = box
    add_edit(run.collection, material="Rubber")
    bake_edits(run.collection, run_folder / "mesh.glb", tmp_path)
    roughness = textures(tmp_path / "textures")["roughness"][..., 0]
    texel = np.rint(mesh.uv * SIZE - 0.5).astype(int)
    for step in np.indices((3, 3)).reshape(2, -1).T - 1:
        column, row = (texel + step).clip(0, SIZE - 1).T
        assert set(roughness[SIZE - 1 - row, column]) <= {229, 230}
    assert (roughness == 76).any() or (roughness == 77).any()  # far from all charts


@pytest.mark.parametrize("ending", [".usdc", ".fbx"])
def test_other_files_have_the_edits_too(box, run_folder, tmp_path, ending):
    run, _ = box
    add_edit(run.collection, material="Rubber")
    export_mesh(run.collection, tmp_path / f"a{ending}", "Unity")
    found = textures(tmp_path / "a textures")
    assert (found["metallic"] == 0).mean() > 0.5 and (found["roughness"] >= 229).mean() > 0.5
    for name in ("normal", "occlusion"):
        source = run_folder / "textures" / f"{name}.png"
        assert (tmp_path / "a textures" / f"{name}.png").read_bytes() == source.read_bytes()
    assert (np.asarray(Image.open(tmp_path / "a textures" / "metallic_smoothness.png"))[..., 3] == 25).mean() > 0.5


def test_a_new_run_has_its_mesh_without_the_trainer(box, run_folder, tmp_path, scene):
    run, _ = box
    add_edit(run.collection, material="Rubber")
    before = {file.name: file.read_bytes() for file in run_folder.rglob("*") if file.is_file()}
    export_run(run.collection, tmp_path / "rubber")
    assert {file.name: file.read_bytes() for file in run_folder.rglob("*") if file.is_file()} == before
    kept = {"normal", "occlusion"}
    names = {file.name for file in (tmp_path / "rubber" / "textures").iterdir()}
    assert names == {f"{name}.png" for name in (*EDITED, *kept)} | {f"{name}.exr" for name in kept}
    again = import_run(tmp_path / "rubber", scene)
    export_mesh(again.collection, tmp_path / "a.glb")
    assert (pictures(tmp_path / "a.glb")[1][..., 1] >= 229).mean() > 0.5


def test_what_is_missing_is_said_before_a_file_is_chosen(box, run_folder, addon, tmp_path):
    exports = [bpy.ops.refgs.export_mesh, bpy.ops.refgs.export_mesh_usd, bpy.ops.refgs.export_mesh_fbx]
    others = [bpy.ops.refgs.export_splats, bpy.ops.refgs.apply_edits]
    assert all(export.poll() for export in (*exports, bpy.ops.refgs.export_light, *others))
    assert not bpy.ops.refgs.export_display_splats.poll()  # no trainer is set up
    add_edit(box[0].collection)
    for number, export in enumerate(exports):
        export(filepath=str(tmp_path / f"{number}{ENDINGS[number]}"))
        assert (tmp_path / f"{number}{ENDINGS[number]}").stat().st_size
    addon_utils.disable("io_scene_fbx")
    assert not bpy.ops.refgs.export_mesh_fbx.poll()
    addon_utils.enable("io_scene_fbx")
    for name, blocked in (
        ("environment.exr", [bpy.ops.refgs.export_light]),
        ("mesh.glb", exports),
        ("splats.ply", others),
    ):
        (run_folder / name).rename(run_folder / f"{name} away")
        assert not any(export.poll() for export in blocked)
        (run_folder / f"{name} away").rename(run_folder / name)


@pytest.mark.parametrize("ending", ENDINGS)
def test_without_textures_beside_the_mesh_those_inside_it_are_taken(box, run_folder, tmp_path, ending):
    run, _ = box
    upper_half(run)
    for folder in ("beside", "inside"):
        (tmp_path / folder).mkdir()
    export_mesh(run.collection, tmp_path / "beside" / f"a{ending}")
    (run_folder / "textures").rename(tmp_path / "away")
    export_mesh(run.collection, tmp_path / "inside" / f"a{ending}")
    if ending == ".glb":
        for one, other in zip(*(pictures(tmp_path / folder / "a.glb") for folder in ("beside", "inside")), strict=True):
            np.testing.assert_array_equal(one, other)
    else:
        beside, inside = (textures(tmp_path / folder / "a textures") for folder in ("beside", "inside"))
        for name in beside:
            np.testing.assert_array_equal(beside[name], inside[name])
    assert not (run_folder / "textures").exists()
    export_run(run.collection, tmp_path / "new")
    assert (tmp_path / "new" / "mesh.glb").is_file() and (tmp_path / "new" / "textures" / "normal.png").is_file()


def test_a_mesh_without_pictures_is_refused_in_one_line(box, run_folder, tmp_path):
    run, _ = box
    add_edit(run.collection)
    (run_folder / "textures").rename(tmp_path / "away")
    rewrite_glb(run_folder / "mesh.glb", lambda tree: tree["materials"][0].pop("normalTexture"))
    with pytest.raises(InputError, match="not a mesh that RefGS wrote: make the run's mesh again"):
        export_mesh(run.collection, tmp_path / "a.glb")
    export_run(run.collection, tmp_path / "new")
    assert not (tmp_path / "new" / "mesh.glb").exists()


def test_a_new_run_has_a_mesh_by_the_trainer_where_it_is_set_up(box, addon, python, tmp_path):
    add_edit(box[0].collection)
    bpy.ops.refgs.apply_edits(filepath=str(tmp_path / "without"))
    assert (tmp_path / "without" / "mesh.glb").is_file() and not jobs.JOBS
    preferences.preferences().python = str(python)
    bpy.ops.refgs.apply_edits(filepath=str(tmp_path / "with"))
    assert jobs.JOBS[-1].commands == [{"command": "export", "run": str(tmp_path / "with")}]
    assert not (tmp_path / "with" / "mesh.glb").exists()
