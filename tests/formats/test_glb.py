import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.formats.exr import read_exr
from refgs.formats.gltf import read_glb, write_glb
from refgs.formats.tangents import vertex_tangents
from tests.makers.box import glb_chunks, rewrite_glb, textured_box


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("a run, été")
    mesh, textures = textured_box()
    write_glb(folder / "mesh.glb", mesh, textures)
    return folder, mesh, textures


def test_what_mirrors_nothing_is_written_so(written, tmp_path):
    _, mesh, textures = written
    write_glb(tmp_path / "mesh.glb", mesh, replace(textures, specular=0.0))
    gltf, _ = glb_chunks(tmp_path / "mesh.glb")
    assert gltf["materials"][0]["extensions"] == {"KHR_materials_specular": {"specularFactor": 0.0}}
    assert gltf["extensionsUsed"] == ["KHR_materials_specular"] and "extensionsRequired" not in gltf


def test_the_folder_holds_what_it_should(written):
    folder, _, textures = written
    names = {"base_color", "metallic", "roughness", "occlusion", "normal"}
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert files == {"mesh.glb"} | {f"textures/{n}.{e}" for n in names for e in ("png", "exr")}
    np.testing.assert_array_equal(read_exr(folder / "textures" / "base_color.exr"), textures.base_color)
    encoded = np.asarray(Image.open(folder / "textures" / "base_color.png")) / 255
    assert np.abs(encoded - srgb_encode(textures.base_color)).max() < 0.51 / 255
    normal = np.asarray(Image.open(folder / "textures" / "normal.png")) / 255 * 2 - 1
    assert np.abs(normal - textures.normal).max() < 0.005


def test_gltf_is_y_up_and_routes_its_channels(written):
    folder, mesh, textures = written
    gltf, binary = glb_chunks(folder / "mesh.glb")
    material = gltf["materials"][0]
    assert material["doubleSided"] and material["name"] == "RefGS"
    surface = material["pbrMetallicRoughness"]
    assert surface.get("metallicFactor", 1) == 1 and surface.get("roughnessFactor", 1) == 1

    def picture(reference):
        view = gltf["bufferViews"][gltf["images"][gltf["textures"][reference["index"]]["source"]]["bufferView"]]
        start = view.get("byteOffset", 0)
        return np.asarray(Image.open(io.BytesIO(binary[start : start + view["byteLength"]])))

    channels = [round(value * 255) for value in (0.9, 0.3, 0.75)]  # occlusion, roughness, metallic
    np.testing.assert_array_equal(picture(surface["metallicRoughnessTexture"])[5, 5], channels)
    np.testing.assert_array_equal(picture(material["normalTexture"])[5, 5], [204, 128, 230])
    assert np.abs(picture(surface["baseColorTexture"]) / 255 - srgb_encode(textures.base_color)).max() < 0.51 / 255
    assert {"POSITION", "NORMAL", "TEXCOORD_0"} <= gltf["meshes"][0]["primitives"][0]["attributes"].keys()

    again = trimesh.load(folder / "mesh.glb", process=False).to_geometry()
    np.testing.assert_allclose(again.bounds, [[-1, 0, -2], [1, 6, 2]], atol=1e-6)
    np.testing.assert_allclose(again.vertices, mesh.vertices[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    np.testing.assert_allclose(again.visual.uv, mesh.uv, atol=1e-6)


def test_blender_imports_it_upright_with_the_right_material(written):
    bpy = pytest.importorskip("bpy")
    from tests.makers.blender import principled

    folder, mesh, _ = written
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(folder / "mesh.glb"))
    found = next(o for o in bpy.data.objects if o.type == "MESH")
    world = np.array([found.matrix_world @ v.co for v in found.data.vertices])
    np.testing.assert_allclose([world.min(0), world.max(0)], [[-1, -2, 0], [1, 2, 6]], atol=1e-5)

    shader = principled(found.data.materials[0])

    def source(socket):
        link = socket.links[0]
        node = (
            link.from_node.inputs[0].links[0].from_node if link.from_node.type == "SEPARATE_COLOR" else link.from_node
        )
        return link.from_socket.name, node.image.colorspace_settings.name

    assert source(shader.inputs["Base Color"])[1] == "sRGB"
    assert source(shader.inputs["Metallic"]) == ("Blue", "Non-Color")
    assert source(shader.inputs["Roughness"]) == ("Green", "Non-Color")
    bend = shader.inputs["Normal"].links[0].from_node
    assert bend.type == "NORMAL_MAP" and bend.space == "TANGENT"
    assert source(bend.inputs["Color"])[1] == "Non-Color"

    # The normal map was baked for `vertex_tangents`: Blender must compute the same tangents.
    data = found.data
    data.calc_tangents()
    turn = np.array(found.matrix_world.to_3x3())
    tangents, signs = vertex_tangents(mesh)
    place = cKDTree(np.concatenate([mesh.vertices, mesh.uv], axis=1))
    assert len(data.loops) == 3 * len(mesh.faces)
    for loop, uv in zip(data.loops, data.uv_layers[0].uv, strict=True):
        position = found.matrix_world @ data.vertices[loop.vertex_index].co
        distance, index = place.query([*position, *uv.vector])
        assert distance < 1e-4
        assert np.dot(loop.tangent, tangents[index] @ turn) > 0.999
        assert loop.bitangent_sign == signs[index]


@pytest.mark.parametrize(
    "edit",
    [
        lambda tree: tree["buffers"].__setitem__(0, {"uri": "/dev/zero", "byteLength": 64}),
        lambda tree: tree["images"].append({"uri": "../secret.png"}),
        lambda tree: tree["accessors"][0].update(count=10**12),
        lambda tree: tree.update(accessors=[{"componentType": 5126, "type": "VEC3", "count": 10**10}]),
    ],
)
def test_a_file_that_reaches_beyond_itself_is_refused(tmp_path, edit):
    """Check that no other file is read, and no memory taken, for a mesh of a run that somebody else made."""
    mesh, textures = textured_box()
    write_glb(tmp_path / "mesh.glb", mesh, textures)
    assert len(read_glb(tmp_path / "mesh.glb").faces) == len(mesh.faces)
    rewrite_glb(tmp_path / "mesh.glb", edit)
    with pytest.raises(InputError, match="is not a whole binary glTF file of a mesh"):
        read_glb(tmp_path / "mesh.glb")


@pytest.mark.parametrize(
    "uri", ["/etc/passwd", "../secret.bin", "beside.bin", "file:///etc/passwd", "https://example.org/a.bin"]
)
def test_a_glb_that_names_another_file_is_refused(tmp_path, monkeypatch, uri):
    """Check that a buffer's URI opens no file, wherever that is."""
    (tmp_path / "beside.bin").write_bytes(bytes(4096))
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    file = tmp_path / "a.glb"
    file.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    opened, known = [], open
    monkeypatch.setattr(
        "builtins.open", lambda name, *more, **others: (opened.append(name), known(name, *more, **others))[1]
    )
    with pytest.raises(InputError, match=r"a\.glb is not a whole binary glTF file"):
        read_glb(file)
    assert not [name for name in opened if isinstance(name, str | Path) and Path(name) != file]
