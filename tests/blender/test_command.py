"""Test `python -m refgs_addon.preview`, which imports a run and renders it without a window."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from refgs_addon.preview import main
from tests.makers.runs import SIZE, read_exr, write_panorama

ROOT = Path(__file__).resolve().parents[2]


def command(*arguments, **environment):
    words = [sys.executable, "-m", "refgs_addon.preview", *map(str, arguments)]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, **environment})


def test_previews_and_blend(run_folder, tmp_path):
    dusk, out, blend = tmp_path / "dusk.exr", tmp_path / "previews", tmp_path / "pot.blend"
    write_panorama(dusk, np.full((16, 32, 3), [0.8, 0.4, 0.2]))
    done = command(run_folder, "--hdri", dusk, "--out", out, "--blend", blend, "--views", "shifted", "--size", 32)
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(e["done"], e["total"]) for e in events if e["event"] == "progress"] == [(0, 0), (0, 2), (1, 2), (2, 2)]
    names = [f"dusk_{part}_shifted.{kind}" for part in ("splats", "mesh") for kind in ("png", "exr")]
    assert sorted(p.name for p in out.iterdir()) == sorted(names)
    assert events[-1]["files"] == [str(out / name) for name in names if name.endswith("png")]
    assert read_exr(out / names[1]).shape == (20, 32, 4)

    # The .blend is self-contained: it has the light without the run folder.
    (run_folder / "environment.exr").unlink()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    light = bpy.context.scene.world["refgs_recovered"]
    np.testing.assert_allclose(light.pixels[:3], 0.5, atol=1e-3)
    assert len(bpy.data.objects["pot splats"].data.points) == 40
    assert bpy.context.scene.render.resolution_x == SIZE


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--hdri", "none.exr"], "there is no light none.exr"),
        (["--hdri", "sky.exr", "--views", "behind"], "has no view behind"),
    ],
)
def test_bad_input_is_one_line(run_folder, tmp_path, capfd, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    write_panorama("sky.exr", np.ones((8, 16, 3)))
    assert main([str(run_folder), *arguments, "--out", "out", "--blend", "a.blend"]) == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if says in line]
    assert line.startswith((says, str(run_folder)))
    assert not Path("a.blend").exists() and not Path("out").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="names the shared libraries of Linux")
def test_missing_libraries_are_named(run_folder, tmp_path):
    """Check that the error message names a missing system library. A fake of the system's tool `ldd` reports the library as missing."""
    tool = tmp_path / "bin" / "ldd"
    tool.parent.mkdir()
    tool.write_text("#!/bin/sh\nprintf '\\tlibXfixes.so.3 => not found\\n\\tlibm.so.6 => /lib/libm.so.6 (0x1)\\n'\n")
    tool.chmod(0o755)
    path = f"{tool.parent}:{os.environ['PATH']}"
    done = command(run_folder, "--hdri", "a.exr", "--out", tmp_path, "--blend", "a.blend", PATH=path)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("Blender cannot start without libXfixes.so.3: ")
    assert "apt-get install" in done.stderr and done.stderr.count("\n") == 1
