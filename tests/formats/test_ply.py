"""Test reading PLY files of other programs, and damaged files."""

import subprocess
import sys
import tracemalloc
import warnings

import numpy as np
import pytest
from numpy.lib.recfunctions import append_fields
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from refgs.color import srgb_decode
from refgs.errors import InputError, InputWarning
from refgs.export.export_job import export
from refgs.formats.ply import read_ply
from refgs.formats.splats import read_splats, write_display_splats, write_splats
from tests.makers import plys
from tests.makers.splats import arrays, make

COUNT = 50
GEOMETRY = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "rot_0", "rot_1", "rot_2", "rot_3"]
NORMALS = ["nx", "ny", "nz"]
LAYOUTS = {
    "3DGS": [*GEOMETRY, *NORMALS, *(f"f_rest_{i}" for i in range(45)), "scale_0", "scale_1", "scale_2"],
    "2DGS": [*GEOMETRY, *NORMALS, *(f"f_rest_{i}" for i in range(45)), "scale_0", "scale_1"],
    "without normals": [*GEOMETRY, "scale_0", "scale_1"],
    "Ref-Gaussian": [
        *(*GEOMETRY, "scale_0", "scale_1", "refl_strength", "roughness", "metalness"),
        *("ori_color_0", "ori_color_1", "ori_color_2"),
    ],
}


def table(names, count=COUNT, kind="<f4"):
    """Make random PLY rows like those of 3D Gaussian splatting: quaternions are not normalised, and normals are zero."""
    rng = np.random.default_rng(3)
    rows = np.empty(count, [(name, kind) for name in names])
    for name in names:
        rows[name] = 0 if name in NORMALS else rng.normal(-1, 1, count)
    return rows


def save(path, rows, *more, format="<"):
    """Write `rows` as the vertices of a PLY file. `more` are further elements.

    `format` is "text", or the byte order of a binary file: "<" for little-endian, ">" for big-endian.
    """
    how = {"text": True} if format == "text" else {"byte_order": format}
    PlyData([PlyElement.describe(rows, "vertex"), *more], **how).write(str(path))
    return path


def vertices(path):
    return PlyData.read(str(path))["vertex"].data


def stacked(rows, *names):
    return np.stack([rows[name] for name in names], axis=1)


def covariances(rows):
    """Compute the covariances (N, 3, 3) of the Gaussians in a PLY's rows."""
    scales = [np.exp(rows[f"scale_{i}"]) for i in range(3) if f"scale_{i}" in rows.dtype.names]
    scales = np.stack(scales + [0 * scales[0]] * (3 - len(scales)), axis=1)
    turn = Rotation.from_quat(stacked(rows, "rot_1", "rot_2", "rot_3", "rot_0")).as_matrix() * scales[:, None]
    return turn @ turn.transpose(0, 2, 1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_other_programs_splats(tmp_path, layout):
    rows = table(LAYOUTS[layout])
    splats = read_splats(save(tmp_path / "des éclats.ply", rows))
    axes = sum(name.startswith("scale_") for name in rows.dtype.names)
    assert splats.scales.shape == (COUNT, axes)
    np.testing.assert_array_equal(splats.positions, stacked(rows, "x", "y", "z"))
    np.testing.assert_allclose(splats.opacities, 1 / (1 + np.exp(-rows["opacity"])), rtol=1e-6)
    turn = Rotation.from_quat(splats.rotations[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(splats.normals, turn[:, :, 2], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(splats.rotations, axis=1), 1, atol=1e-4)
    assert (splats.scales[:, -1:] <= splats.scales).all() or axes == 2
    write_splats(tmp_path / "ours.ply", splats)
    np.testing.assert_allclose(covariances(vertices(tmp_path / "ours.ply")), covariances(rows), rtol=1e-4, atol=1e-5)
    write_display_splats(tmp_path / "display.ply", splats)
    shown = vertices(tmp_path / "display.ply")
    # The squared thickness that flat splats are given.
    thin = 3e-3 * np.exp(2 * np.minimum(rows["scale_0"], rows["scale_1"]))
    slack = 1e-5 if axes == 3 else thin[:, None, None] + 1e-5
    assert (np.abs(covariances(shown) - covariances(rows)) <= slack + 1e-4 * np.abs(covariances(rows))).all()
    for name in ("f_dc_1", "f_rest_17"):
        if name in rows.dtype.names:
            np.testing.assert_array_equal(shown[name], rows[name])


def test_materials_where_there_are_none(tmp_path):
    rows = table(LAYOUTS["3DGS"])
    splats = read_splats(save(tmp_path / "a.ply", rows))
    colour = 0.5 + stacked(rows, "f_dc_0", "f_dc_1", "f_dc_2") / (2 * np.sqrt(np.pi))
    np.testing.assert_allclose(splats.albedo, srgb_decode(colour.clip(0, 1)), rtol=1e-5, atol=1e-7)
    assert (splats.metallic == 0).all() and (splats.roughness == 1).all()
    assert (splats.received == 1).all() and splats.indirect.shape == (COUNT, 0, 3)


def test_materials_of_ref_gaussian(tmp_path):
    rows = table(LAYOUTS["Ref-Gaussian"])
    splats = read_splats(save(tmp_path / "a.ply", rows))
    colour = 1 / (1 + np.exp(-stacked(rows, "ori_color_0", "ori_color_1", "ori_color_2")))
    np.testing.assert_allclose(splats.albedo, srgb_decode(colour), rtol=1e-5)
    np.testing.assert_allclose(splats.metallic, 1 / (1 + np.exp(-rows["refl_strength"])), rtol=1e-5)
    np.testing.assert_allclose(splats.roughness, 1 / (1 + np.exp(-rows["roughness"])), rtol=1e-5)
    write_splats(tmp_path / "b.ply", splats)
    np.testing.assert_array_equal(read_splats(tmp_path / "b.ply").roughness, splats.roughness)
    assert "metalness" in vertices(tmp_path / "b.ply").dtype.names


@pytest.mark.parametrize("kind", ["<f4", ">f8"])
@pytest.mark.parametrize("format", ["text", "<", ">"])
def test_formats(tmp_path, format, kind):
    rows = table(LAYOUTS["3DGS"], kind=kind)
    splats = read_splats(save(tmp_path / "a.ply", rows, format=format))
    for name, value in arrays(read_splats(save(tmp_path / "b.ply", rows))).items():
        np.testing.assert_allclose(getattr(splats, name), value, rtol=1e-6, atol=1e-7)


def test_what_is_unknown_is_kept(tmp_path):
    rows = table(LAYOUTS["3DGS"])
    both = np.empty(COUNT, [*rows.dtype.descr, ("semantic", "<i2"), ("confidence", "<f8"), ("seen_by", "O")])
    for name in rows.dtype.names:
        both[name] = rows[name]
    both["semantic"], both["confidence"] = np.arange(COUNT), np.linspace(0, 1, COUNT)
    both["seen_by"] = [np.arange(i % 3, dtype="<u2") for i in range(COUNT)]
    faces = np.empty(2, [("vertex_indices", "O"), ("flag", "u1")])
    faces["vertex_indices"], faces["flag"] = [np.array([0, 1, 2], "<i4"), np.array([3, 4], "<i4")], [7, 8]
    listed = {"len_types": {"seen_by": "u1"}, "val_types": {"seen_by": "u2"}}
    vertex = PlyElement.describe(both, "vertex", **listed)
    PlyData([PlyElement.describe(faces, "face"), vertex], byte_order="<").write(str(tmp_path / "a.ply"))
    write_splats(tmp_path / "b.ply", read_splats(tmp_path / "a.ply"))
    write_splats(tmp_path / "b.ply", read_splats(tmp_path / "b.ply"))  # overwrite the file that was read
    again = PlyData.read(str(tmp_path / "b.ply"))
    assert again.byte_order == "<" and [e.name for e in again.elements] == ["vertex", "face"]
    for name in ("semantic", "confidence"):
        np.testing.assert_array_equal(again["vertex"][name], both[name])
        assert again["vertex"][name].dtype == both.dtype[name]
    assert again["vertex"]["seen_by"][5].tolist() == [0, 1] and again["vertex"]["seen_by"][5].dtype == "u2"
    assert [list(row) for row in again["face"]["vertex_indices"]] == [[0, 1, 2], [3, 4]]
    assert again["face"]["flag"].tolist() == [7, 8]


def test_rows_that_are_not_finite_are_left_out(tmp_path):
    rows = append_fields(table(LAYOUTS["3DGS"]), "semantic", np.arange(COUNT, dtype="<i4"), usemask=False)
    rows["x"][3], rows["f_rest_7"][[3, 8]], rows["scale_1"][10], rows["scale_2"][20] = np.nan, np.inf, np.inf, 1e4
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        rows[name][30] = 0
    rows["opacity"][40], rows["opacity"][41] = np.inf, -np.inf  # 1 and 0
    with pytest.warns(InputWarning, match=r"a\.ply: 5 of 50 splats have positions, .*: left out") as said:
        splats = read_splats(save(tmp_path / "a.ply", rows))
    assert len(said) == 1 and "\n" not in str(said[0].message)
    kept = np.setdiff1d(np.arange(COUNT), [3, 8, 10, 20, 30])
    np.testing.assert_array_equal(splats.positions, stacked(rows, "x", "y", "z")[kept])
    assert splats.opacities[[35, 36]].tolist() == [1, 0]
    write_splats(tmp_path / "b.ply", splats)
    np.testing.assert_array_equal(vertices(tmp_path / "b.ply")["semantic"], kept)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_splats(tmp_path / "b.ply")) == len(kept)


def in_header(old, new):
    return lambda data: data.replace(old, new, 1)


@pytest.mark.parametrize("format", ["<", "text"])
@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda data: data[:-300], "truncated|not a whole PLY"),
        (lambda data: data[:60], "its header is broken"),
        (lambda data: b"", "not a PLY file"),
        (lambda data: b"not a ply file", "not a PLY file"),
        (lambda data: b"\xff\xfe\x00" * 50, "not a PLY file"),
        (in_header(b"vertex 50", b"vertex 49"), "more rows than its header says"),
        (in_header(b"vertex 50", b"vertex 51"), "truncated|not a whole PLY"),
        (in_header(b"vertex 50", b"vertex 999999999999999999999"), "truncated"),
        (in_header(b"vertex 50", b"vertex -50"), "broken line in its header, “element vertex -50”"),
        (in_header(b"vertex 50", b"vertex"), "broken line in its header"),
        (in_header(b"element vertex", b"element vertices"), "no element vertex"),
        (in_header(b"float x", b"floaty x"), "unknown type, floaty"),
        (in_header(b"property float x\n", b"property list uchar strange x\n"), "unknown type, strange"),
        (in_header(b"property float x\n", b"property list x\n"), "unknown type, list"),
        (in_header(b"property float x\n", b"property list uchar x\n"), "broken line in its header"),
        (in_header(b"property float x\n", b"property float y\n"), "two properties with same name"),
        (in_header(b"property float x\n", b"\n"), "lacks x|more rows|not a whole PLY"),
        (in_header(b"property float x\n", b"comment \xe9t\xe9\nproperty float x\n"), "not plain ASCII"),
        (in_header(b" 1.0\n", b" 3.0\n"), "not a whole PLY"),
        (in_header(b"format ", b"shape "), "format|PLY"),
        (in_header(b"end_header", b"element empty 999999999\nend_header"), "element without properties"),
        (in_header(b"property float f_rest_44\n", b"property float f_rest_45\n"), "45 f_rest_ values"),
        (in_header(b"property float f_dc_0\n", b"property float packed_position\n"), "compressed PLY"),
        (in_header(b"property float opacity\n", b"property float opacities\n"), "lacks opacity"),
        (in_header(b"property float opacity\n", b"property float metallic\n"), "lacks opacity, albedo_r"),
    ],
)
def test_broken_files_are_named(tmp_path, format, spoil, says):
    path = save(tmp_path / "a.ply", table(LAYOUTS["3DGS"]), format=format)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=says) as said:
        read_splats(path)
    assert "\n" not in str(said.value) and "a.ply" in str(said.value)


def test_missing_files_are_named(tmp_path):
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(InputError, match="cannot read"):
            read_splats(path)


def test_our_own_lacks_nothing(tmp_path):
    path = tmp_path / "splats.ply"
    write_splats(path, make())
    path.write_bytes(path.read_bytes().replace(b"property float roughness", b"property float roughmess"))
    with pytest.raises(InputError, match="lacks roughness"):
        read_splats(path)


@pytest.mark.parametrize("format", ["text", "<", ">"])
def test_no_damage_is_a_fault_of_ours(tmp_path, format):
    """Check that a damaged file is read as finite splats, or refused with a one-line error.

    The test changes, removes and inserts random bytes, mostly in the header.
    """
    rng = np.random.default_rng(7)
    rows = table(LAYOUTS["2DGS"], 6)
    face = PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "O")]), "face")
    path = save(tmp_path / "a.ply", rows, face, format=format)
    whole = path.read_bytes()
    header = whole.index(b"end_header") + 12
    refused = 0
    for _ in range(400):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(header if rng.random() < 0.7 else len(data)))
            match rng.integers(4):
                case 0:
                    data[at : at + 1] = bytes(rng.integers(256, size=1, dtype=np.uint8))
                case 1:
                    del data[at : at + int(rng.integers(1, 30))]
                case 2:
                    data[at:at] = rng.choice([b"9", b"-", b"\n", b" ", b"\x00", b"element a 3\n", b"nan ", b"list "])
                case 3:
                    data[at:at] = data[: int(rng.integers(60))]
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            try:
                splats = read_splats(path)
                assert all(np.isfinite(value).all() for value in arrays(splats).values())
            except InputError as error:
                refused += 1
                assert "\n" not in str(error)
    assert 100 < refused < 400


def test_a_giant_count_reserves_nothing(tmp_path):
    path = save(tmp_path / "a.ply", table(LAYOUTS["3DGS"]), format="text")
    path.write_bytes(path.read_bytes().replace(b"vertex 50", b"vertex 4000000000"))
    tracemalloc.start()
    with pytest.raises(InputError, match="truncated"):
        read_ply(path)
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()


def test_the_command_line_converts_them(tmp_path):
    rows = table(LAYOUTS["2DGS"])
    rows["x"][3] = np.nan
    source, shown, ours = save(tmp_path / "d'un autre.ply", rows), tmp_path / "shown.ply", tmp_path / "ours.ply"
    words = ["export", str(source), "--display-splats", str(shown), "--splats", str(ours)]
    said = subprocess.run([sys.executable, "-m", "refgs.cli", *words], capture_output=True, text=True, timeout=300)
    assert said.returncode == 0
    left_out = f"{source}: 1 of 50 splats have positions that are not finite: left out"
    assert left_out.replace(" ", "") in "".join(said.stdout.split()) and not said.stderr
    vertex = vertices(shown)
    assert len(vertex) == COUNT - 1 and "scale_2" in vertex.dtype.names and "metallic" not in vertex.dtype.names
    assert len(read_splats(ours)) == COUNT - 1
    with pytest.raises(InputError, match="is no run folder, so there is no mesh: add --splats"):
        export(source, None, None, None, None, False, lambda event, facts: None)
    with pytest.raises(InputError, match=r"ours\.ply exists"):
        export(ours, None, None, ours, None, False, lambda event, facts: None)


@pytest.mark.parametrize("case", plys.READ)
def test_files_that_the_add_on_reads_too(tmp_path, case):
    (tmp_path / "a.ply").write_bytes(plys.READ[case]())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        splats = read_splats(tmp_path / "a.ply")
    rows = np.delete(plys.rows(), plys.LEFT_OUT.get(case, ()))
    np.testing.assert_array_equal(splats.positions, stacked(rows, "x", "y", "z"))
    np.testing.assert_array_equal(splats.normals, stacked(rows, "nx", "ny", "nz"))
    np.testing.assert_allclose(splats.scales, np.exp(stacked(rows, "scale_0", "scale_1")), rtol=1e-6)
    if case != "others' materials":
        np.testing.assert_array_equal(splats.albedo, stacked(rows, "albedo_r", "albedo_g", "albedo_b"))
        np.testing.assert_array_equal(splats.roughness, rows["roughness"])


@pytest.mark.parametrize("case", plys.REFUSED)
def test_files_that_the_add_on_refuses_too(tmp_path, case):
    (tmp_path / "a.ply").write_bytes(plys.REFUSED[case]())
    with pytest.raises(InputError, match=r"a\.ply") as said:
        read_splats(tmp_path / "a.ply")
    assert "\n" not in str(said.value)
