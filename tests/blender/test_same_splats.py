"""Test that the add-on reads the PLY and SPZ files that the trainer reads, as the same splats, and refuses the same."""

import warnings

import numpy as np
import pytest

from refgs.errors import InputError as InputErrorOfRefgs
from refgs.errors import InputWarning
from refgs.export.turned import turned
from refgs.formats.mesh import Y_UP
from refgs.formats.splats import read_splats as read_by_refgs
from refgs.formats.spz import read_spz, write_spz
from refgs_addon.errors import InputError
from refgs_addon.scene.splat_cloud import read_splats
from tests.makers import plys
from tests.makers.splats import make
from tests.makers.spz import write_spz_2


def same(path):
    """Check that both readers read a file as the same splats. Returns the add-on's, and how many it left out."""
    splats, left_out = read_splats(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        expected = turned(read_spz(path), Y_UP.T) if path.suffix == ".spz" else read_by_refgs(path)
    np.testing.assert_array_equal(splats["position"], expected.positions)
    normals = expected.normals / np.linalg.norm(expected.normals, axis=1, keepdims=True)
    np.testing.assert_allclose(splats["normal"], normals, atol=1e-6)
    np.testing.assert_allclose(splats["scale"], expected.scales[:, :2], rtol=1e-5)
    np.testing.assert_allclose(splats["rotation"], expected.rotations, atol=1e-6)
    np.testing.assert_allclose(splats["opacity"], expected.opacities, atol=1e-6)
    np.testing.assert_allclose(splats["base_color"], expected.albedo, atol=1e-5)
    np.testing.assert_allclose(splats["metallic"], expected.metallic, atol=1e-6)
    np.testing.assert_allclose(splats["roughness"], expected.roughness, atol=1e-6)
    return splats, left_out


@pytest.mark.parametrize("case", plys.READ)
def test_files_that_the_trainer_reads(tmp_path, case):
    (tmp_path / "a.ply").write_bytes(plys.READ[case]())
    splats, left_out = same(tmp_path / "a.ply")
    gone = plys.LEFT_OUT.get(case, ())
    rows = np.delete(plys.rows(), gone)
    assert left_out == len(gone)
    np.testing.assert_array_equal(splats["position"], np.stack([rows[axis] for axis in "xyz"], axis=1))


def test_materials_of_ref_gaussian(tmp_path):
    table = np.zeros(plys.COUNT, [(name, "<f4") for name in (*plys.NAMES, "refl_strength", "roughness",
                                                             *(f"ori_color_{i}" for i in range(3)))])  # fmt: skip
    for i, name in enumerate(table.dtype.names):
        table[name] = plys.rows()[name] if name in plys.NAMES else np.linspace(-2, 2, plys.COUNT) + 0.1 * i
    table["roughness"][2] = np.inf  # a logit
    (tmp_path / "a.ply").write_bytes(plys.encode(table))
    splats, left_out = same(tmp_path / "a.ply")
    assert left_out == 0 and splats["roughness"][2] == 1


@pytest.mark.parametrize("case", plys.REFUSED)
def test_files_that_the_trainer_refuses(tmp_path, case):
    (tmp_path / "a.ply").write_bytes(plys.REFUSED[case]())
    with pytest.raises(InputError, match=r"a\.ply") as said:
        read_splats(tmp_path / "a.ply")
    assert "\n" not in str(said.value)


SPZ = {
    "version 4": lambda file: write_spz(file, make(50, 16)),
    "version 4 without harmonics": lambda file: write_spz(file, make(50, 1)),
    "version 2": lambda file: write_spz_2(file, make(50, 4)),
}


@pytest.mark.parametrize("case", SPZ)
def test_spz(tmp_path, case):
    SPZ[case](tmp_path / "a.spz")
    splats, left_out = same(tmp_path / "a.spz")
    assert len(splats["position"]) == 50 and not left_out


@pytest.mark.parametrize("case", SPZ)
def test_damaged_spz(tmp_path, case):
    """Damage a byte, or truncate the file. Check that both readers read the same, or refuse it."""
    SPZ[case](tmp_path / "whole.spz")
    data, dice = (tmp_path / "whole.spz").read_bytes(), np.random.default_rng(0)
    refused = 0
    for number in range(200):
        place = int(dice.integers(len(data) if number % 2 else 40))
        damaged = data[:place] + bytes([dice.integers(256)]) + data[place + 1 :] if number % 4 else data[:place]
        (tmp_path / "a.spz").write_bytes(damaged)
        try:
            read_splats(tmp_path / "a.spz")
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and "a.spz" in str(error)
            if "no splat with finite values" not in str(error) and damaged:
                with pytest.raises(InputErrorOfRefgs):
                    read_spz(tmp_path / "a.spz")
        else:
            same(tmp_path / "a.spz")
    assert 50 < refused < 200
