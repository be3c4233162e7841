"""Test scripts/example_run.py: it makes runs small, and what remains is equal."""

import io

import numpy as np
import trimesh
from PIL import Image

from refgs.formats.gltf import write_glb
from scripts.example_run import BITS, short, small_mesh
from tests.makers.box import glb_chunks, textured_box


def test_numbers_are_rounded_to_fewer_bits():
    values = np.random.default_rng(0).normal(size=1000).astype(np.float32)
    found = short(values)
    np.testing.assert_allclose(found, values, rtol=2.0 ** -(BITS + 1))
    assert not (found.view(np.uint32) & ((1 << (23 - BITS)) - 1)).any()
    assert short(np.zeros(3, np.float32)).tolist() == [0, 0, 0]


def test_a_mesh_is_smaller_and_the_same(tmp_path):
    file = tmp_path / "mesh.glb"
    write_glb(file, *textured_box())
    data = file.read_bytes()
    (tmp_path / "small.glb").write_bytes(small_mesh(data))
    before, after = (trimesh.load(tmp_path / name, force="mesh", process=False) for name in ("mesh.glb", "small.glb"))
    np.testing.assert_allclose(after.vertices, before.vertices, rtol=1e-3)
    np.testing.assert_array_equal(after.faces, before.faces)
    np.testing.assert_allclose(after.visual.uv, before.visual.uv, atol=1e-3)
    tree, buffer = glb_chunks(tmp_path / "small.glb")
    assert "TANGENT" not in tree["meshes"][0]["primitives"][0]["attributes"]
    for image in tree["images"]:
        view = tree["bufferViews"][image["bufferView"]]
        picture = Image.open(io.BytesIO(buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]))
        assert picture.format == "JPEG" and image["mimeType"] == "image/jpeg"
    assert len((tmp_path / "small.glb").read_bytes()) < len(data)
