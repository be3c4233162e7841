"""Test writing to a full or read-only disk: the old file stays, and no partial file is left."""

import errno
import subprocess

import numpy as np
import pytest

from refgs.errors import InputError
from refgs.export.export_job import export
from refgs.formats.exr import write_exr
from refgs.formats.gltf import write_glb
from refgs.formats.splats import write_display_splats, write_splats
from refgs.formats.splats_gltf import write_splats_glb
from refgs.formats.splats_usd import write_splats_usd
from refgs.formats.spz import write_spz
from refgs.formats.textures import Textures
from tests.makers.box import textured_box
from tests.makers.disk import fill
from tests.makers.splats import arrays, make

RNG = np.random.default_rng(2)


def noisy_box(path, side):
    mesh, textures = textured_box()
    noise = {n: RNG.random((side, side, *v.shape[2:])).astype(np.float32) for n, v in arrays(textures).items()}
    write_glb(path, mesh, Textures(**noise))


WRITERS = {  # each writes at least `size` thousand bytes
    "splats.ply": lambda path, size: write_splats(path, make(10 * size)),
    "display.ply": lambda path, size: write_display_splats(path, make(10 * size)),
    "display.glb": lambda path, size: write_splats_glb(path, make(10 * size)),
    "display.spz": lambda path, size: write_spz(path, make(16 * size)),
    "display.usdc": lambda path, size: write_splats_usd(path, make(10 * size)),
    "environment.exr": lambda path, size: write_exr(path, RNG.random((2 * size, 4 * size, 3))),
    "mesh.glb": lambda path, size: noisy_box(path, 4 * size),
}


def content(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_keeps_what_is_there(small_disk, name):
    path = small_disk / f"un été {name}"
    WRITERS[name](path, 16)
    before = content(small_disk)
    filler = small_disk / "filler"
    fill(filler)
    with pytest.raises(OSError) as said:
        WRITERS[name](path, 64)
    assert said.value.errno == errno.ENOSPC
    filler.unlink()
    assert content(small_disk) == before
    WRITERS[name](path, 16)


@pytest.mark.parametrize("name", WRITERS)
def test_a_disk_that_may_not_be_written_keeps_what_is_there(small_disk, name):
    path = small_disk / name
    WRITERS[name](path, 16)
    before = content(small_disk)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(OSError) as said:
        WRITERS[name](path, 16)
    assert said.value.errno == errno.EROFS and content(small_disk) == before


def test_the_user_is_told_in_one_line(small_disk, tmp_path):
    write_splats(tmp_path / "a.ply", make(4000))
    fill(small_disk / "filler")
    for arguments in ((small_disk / "b.ply", None), (None, small_disk / "b.ply")):
        with pytest.raises(InputError, match=r"No space left on device\): mend that, then export again") as said:
            export(tmp_path / "a.ply", None, None, *arguments, False, lambda event, facts: None)
        assert "\n" not in str(said.value) and not (small_disk / "b.ply").exists()
