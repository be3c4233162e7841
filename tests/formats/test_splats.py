import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from refgs.formats.splats import read_splats, write_splats
from tests.makers.splats import arrays, make


def read(folder, splats):
    """Write splats to a file and read it."""
    write_splats(folder / "s.ply", splats)
    return read_splats(folder / "s.ply")


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("indirect", [0, 16])
def test_round_trip(tmp_path, count, coefficients, indirect):
    splats = make(count, coefficients, indirect)
    path = tmp_path / "a run, été.ply"
    write_splats(path, splats)
    again = read_splats(path)
    assert list(tmp_path.iterdir()) == [path]
    assert again.others == ()
    for name, value in arrays(splats).items():
        read = getattr(again, name)
        assert read.dtype == np.float32 and read.shape == value.shape
        if name in ("opacities", "scales"):
            np.testing.assert_allclose(read, value, rtol=2e-6)
        else:
            np.testing.assert_array_equal(read, value)


def test_layout_is_what_other_programs_expect(tmp_path):
    splats = make()
    splats.opacities[0] = 1
    write_splats(tmp_path / "s.ply", splats)
    data = PlyData.read(tmp_path / "s.ply")
    (vertex,) = data.elements
    assert not data.text and data.byte_order == "<" and vertex.name == "vertex"
    assert [p.name for p in vertex.properties] == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(45)]
        + ["opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
        + ["albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"]
    )
    # f_rest holds the fifteen higher coefficients of red, then those of green, then of blue.
    np.testing.assert_array_equal(vertex["f_rest_2"], splats.sh[:, 3, 0])
    np.testing.assert_array_equal(vertex["f_rest_15"], splats.sh[:, 1, 1])
    np.testing.assert_allclose(vertex["scale_1"], np.log(splats.scales[:, 1]), rtol=1e-6)
    opacity = splats.opacities[1:]
    np.testing.assert_allclose(vertex["opacity"][1:], np.log(opacity / (1 - opacity)), rtol=1e-4, atol=1e-5)
    assert np.isfinite(vertex["opacity"]).all()


@pytest.mark.parametrize("constants", [{}, {"metallic": 1.0}])
def test_doubt_is_a_column_where_it_is_known(tmp_path, constants):
    splats = make()
    assert splats.doubt is None and read(tmp_path, splats).doubt is None, "files of older releases"
    splats.doubt, splats.constants = np.linspace(0, 1, len(splats), dtype=np.float32), constants
    again = read(tmp_path, splats)
    np.testing.assert_array_equal(again.doubt, splats.doubt)
    assert again.others == () and again.constants == constants


def test_others_doubt_is_not_ours(tmp_path):
    """Check that a property `doubt` of a file without materials is kept as unknown."""
    rows = np.zeros(1, [(name, "<f4") for name in ("x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", "doubt",
                                                   "scale_0", "scale_1", *(f"rot_{i}" for i in range(4)))])  # fmt: skip
    rows["rot_0"], rows["doubt"] = 1, 7
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "s.ply"))
    found = read_splats(tmp_path / "s.ply")
    assert found.doubt is None and found.others[0].data["doubt"] == 7


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "splats.ply"
    write_splats(path, make())
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("plyfile.PlyElement._write", full)
    with pytest.raises(OSError):
        write_splats(path, make(9))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
