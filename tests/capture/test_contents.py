"""Test that a change of a capture's photos is noticed, by a run that was trained on them."""

import pytest

from refgs.capture import read_capture
from refgs.errors import InputError
from refgs.run import create_run
from refgs.settings import load_settings
from tests.makers.captures import nerf_blender


def brighten(photo):
    """Change a byte of a photo's file. Its size stays the same."""
    photo.write_bytes(photo.read_bytes()[:-1] + b"\1")


def test_a_changed_photo_is_named(tmp_path):
    folder, run = nerf_blender(tmp_path / "capture"), tmp_path / "run"
    before = read_capture(folder)
    create_run(run, before, load_settings("quick"), "quick", "cpu")
    brighten(folder / "train" / "r_1.png")
    after = read_capture(folder)
    with pytest.raises(InputError, match=r"capture/train/r_1\.png changed since .*run was trained on it: put back"):
        after.check_unchanged(run, before.fingerprint())
    after.check_unchanged(run, before.digest)  # as a run of 0.1.0, which knows sizes only
    brighten(folder / "train" / "r_2.png")
    with pytest.raises(InputError, match=r"r_1\.png and 1 more changed since"):
        read_capture(folder).check_unchanged(run, before.fingerprint())
    (run / "capture.json").write_bytes(b"\xff")
    with pytest.raises(InputError, match="is not the capture that"):
        after.check_unchanged(run, before.fingerprint())


def test_a_file_that_is_gone_before_it_is_hashed_is_named(tmp_path):
    folder = nerf_blender(tmp_path)
    capture = read_capture(folder)
    (folder / "train" / "r_1.png").unlink()
    with pytest.raises(InputError, match=r"cannot read .*r_1\.png: No such file"):
        capture.fingerprint()
