"""Test imported splats that all have the same metallic, roughness or specular.

The header of the PLY file stores this value once, in place of a column.
"""

import numpy as np
import pytest
from plyfile import PlyData

from refgs.formats.splats import read_splats as backend_splats
from refgs_addon.errors import InputError
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import edited_materials, export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.splat_cloud import read_constants
from tests.makers.blender import principled

MATTE = {"metallic": 0.0, "roughness": 1.0, "specular": 0.0}


def move_to_header(folder, constants):
    """Rewrite the run's splats.ply: drop each column named in `constants`, and store its one value in the PLY header."""
    file = folder / "splats.ply"
    data = PlyData.read(str(file))["vertex"].data
    rows = data[[name for name in data.dtype.names if name not in constants]].copy()
    names = "".join(f"property float {name}\n" for name in rows.dtype.names)
    said = "comment SplatRenderMode: 2dgs\n"
    said += "".join(f"comment constant {name} {value:g}\n" for name, value in constants.items())
    packed = np.stack([rows[name] for name in rows.dtype.names], axis=1).astype("<f4")
    head = f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(rows)}\n{names}end_header\n"
    file.write_bytes(head.encode() + packed.tobytes())


def attributes(material):
    """List the names of the attributes that a material's Attribute nodes read."""
    return [node.attribute_name for node in material.node_tree.nodes if node.type == "ATTRIBUTE"]


@pytest.mark.parametrize("constants", [MATTE, {"metallic": 1.0}, {}])
def test_the_material_reads_what_varies_alone(constants, run_folder, scene):
    move_to_header(run_folder, constants)
    run = import_run(run_folder, scene)
    material = run.splats.data.materials[0]
    assert {"metallic", "roughness"} & {*attributes(material)} == {"metallic", "roughness"} - {*constants}
    inputs = principled(material).inputs
    for name, socket in (("metallic", "Metallic"), ("roughness", "Roughness"), ("specular", "Specular IOR Level")):
        if name in constants:
            assert not inputs[socket].links and inputs[socket].default_value == constants[name]
    assert inputs["Specular IOR Level"].default_value == constants.get("specular", 0.5)


def test_an_edit_has_it_read_all(run_folder, scene):
    """Check that after an edit, the material reads metallic and roughness from attributes of the splats.

    Before the edit, both are constants.
    """
    move_to_header(run_folder, MATTE)
    run = import_run(run_folder, scene)
    add_edit(run.collection, "Everywhere", "Gold")
    add_edit(run.collection, "Box", "Gold")
    material = run.splats.data.materials[0]
    assert {"metallic", "roughness", "edit_amount"} <= {*attributes(material)}
    assert principled(material).inputs["Specular IOR Level"].links and attributes(material).count("metallic") == 1
    new = edited_materials(run.splats)
    assert (new["metallic"] == 1).all() and (new["roughness"] < 1).all()


def test_what_is_exported_says_it_as_the_run_did(run_folder, scene, tmp_path):
    """Check that exporting without edits writes the same file, with constant values in the PLY header.

    After an edit to gold, the exported file has columns in place of the constants.
    """
    move_to_header(run_folder, MATTE)
    run = import_run(run_folder, scene)
    export_splats(run.collection, tmp_path / "same.ply")
    assert read_constants(tmp_path / "same.ply") == MATTE
    assert (tmp_path / "same.ply").read_bytes() == (run_folder / "splats.ply").read_bytes()
    assert backend_splats(tmp_path / "same.ply").constants == MATTE
    add_edit(run.collection, "Everywhere", "Gold")
    export_splats(run.collection, tmp_path / "gold.ply")
    gold = backend_splats(tmp_path / "gold.ply")
    assert gold.constants == {} and (gold.metallic == 1).all()


def test_a_column_has_the_last_word(run_folder):
    file = run_folder / "splats.ply"
    file.write_bytes(file.read_bytes().replace(b"element vertex", b"comment constant metallic 0\nelement vertex", 1))
    assert read_constants(file) == {} and backend_splats(file).constants == {}
    move_to_header(run_folder, {"metallic": 0.25})
    file.write_bytes(file.read_bytes().replace(b"metallic 0.25", b"metallic much", 1))
    with pytest.raises(InputError, match="metallic is much, not a number"):
        read_constants(file)
