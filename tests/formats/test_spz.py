"""Test SPZ: each version comes back within its steps, and broken files are refused. test_tools.py compares with another program."""

import gzip
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refgs.color import srgb_decode
from refgs.errors import InputError
from refgs.formats.splats import THIN
from refgs.formats.spz import read_spz, write_spz
from tests.makers.splats import make
from tests.makers.spz import write_spz_2


def turn(splats):
    return Rotation.from_quat(splats.rotations[:, [1, 2, 3, 0]]).as_matrix()


@pytest.mark.parametrize("version", [2, 4])
def test_it_comes_back(tmp_path, version):
    splats = make(300, 4)
    splats.positions[0] = -3.4, 0.2, 0.1
    (write_spz if version == 4 else write_spz_2)(tmp_path / "des éclats.spz", splats)
    back = read_spz(tmp_path / "des éclats.spz")
    step = 2**-21 if version == 4 else 2**-12  # 24 bits: a sign, and two before the point for 3.4
    assert np.abs(back.positions - splats.positions).max() <= step / 2 + 1e-7
    assert np.abs(back.opacities - splats.opacities).max() <= 0.51 / 255
    assert np.abs(back.sh[:, 0] - splats.sh[:, 0]).max() <= 0.51 / (0.15 * 255)
    assert np.abs(back.sh[:, 1:] - splats.sh[:, 1:]).max() <= (4.01 if version == 4 else 0.51) / 128
    if version == 4:
        logs = np.log(np.column_stack([splats.scales, THIN * splats.scales.min(axis=1)]))
        assert np.abs(np.log(back.scales) - logs).max() <= 0.51 / 16
        assert (turn(back) * turn(splats)).sum(axis=1).min() > np.cos(np.radians(0.3))
        # What other programs' splats have none of.
        np.testing.assert_allclose(back.normals, turn(back)[:, :, 2], atol=1e-6)
    np.testing.assert_allclose(back.albedo, srgb_decode((0.5 + 0.28209479 * back.sh[:, 0]).clip(0, 1)), rtol=1e-5)
    assert (back.metallic == 0).all() and (back.roughness == 1).all()


def test_the_rotation_of_version_2(tmp_path):
    splats = make(300, 1)
    splats.scales = np.column_stack([splats.scales, np.full(300, 1e-4, np.float32)])
    splats.rotations[::2] *= -1  # the same turns
    write_spz_2(tmp_path / "a.spz", splats)
    clear = np.abs(splats.rotations[:, 0]) > 0.3  # w follows from the others, and is coarse where it is small
    alike = (turn(read_spz(tmp_path / "a.spz")) * turn(splats)).sum(axis=1)
    assert clear.sum() > 100 and alike[clear].min() > np.cos(np.radians(2.5))


def test_harmonics_above_the_third_degree_are_left_out(tmp_path):
    write_spz_2(tmp_path / "a.spz", make(3, 25))
    assert read_spz(tmp_path / "a.spz").sh.shape == (3, 16, 3)


def test_splats_far_away_are_refused(tmp_path):
    splats = make(3, 1)
    splats.positions[1, 2] = 3e7
    with pytest.raises(InputError, match=r"a\.spz: splats are 3e\+07 units from the origin, too far for SPZ"):
        write_spz(tmp_path / "a.spz", splats)
    assert not any(tmp_path.iterdir())


def changed(data, offset, format, value):
    return data[:offset] + struct.pack(format, value) + data[offset + struct.calcsize(format) :]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"ply\n" + data, "is not an SPZ file"),
        (lambda data: b"", "is not an SPZ file"),
        (lambda data: data[:20], "is not a whole SPZ file"),
        (lambda data: data[:-9], "is not a whole SPZ file"),
        (lambda data: changed(data, 4, "<I", 5), "is SPZ of version 5, but versions 2 to 4 are read"),
        (lambda data: changed(data, 8, "<I", 4_000_000_000), "its header says 4,000,000,000 splats"),
        (lambda data: changed(data, 8, "<I", 6), "another length than its header says"),
        (lambda data: changed(data, 12, "B", 9), "its header is broken"),
        (lambda data: changed(data, 15, "B", 2), "it lacks streams"),
        (lambda data: gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 7, 0, 12, 0, 0)), "it is truncated"),
        (lambda data: gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 1, 0, 0, 12, 0, 0)), "is SPZ of version 1"),
    ],
)
def test_broken_files_are_refused(tmp_path, damage, said):
    write_spz(tmp_path / "a.spz", make(5, 4))
    (tmp_path / "a.spz").write_bytes(damage((tmp_path / "a.spz").read_bytes()))
    with pytest.raises(InputError, match=said):
        read_spz(tmp_path / "a.spz")
