"""Test the demo from rendering photos to the final report, with fewer and smaller photos and a shorter training."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from refgs import commands, demo
from refgs.errors import InputError
from refgs.paths import clone_root

pytest.importorskip("bpy", reason="the demo needs Blender's Python module")
SMALL = ["train.iterations=80", "surfels.start=2000", "surfels.budget=3000", "surfels.hull=48"]
SMALL += ["environment.resolution=16", "indirect.every=30", "indirect.resolution=32"]
SMALL += ["mesh.resolution=48", "mesh.triangles=1000", "mesh.texture=64"]


def test_from_photos_to_the_report(tmp_path, monkeypatch):
    train, out = commands.train, tmp_path / "the demo"

    def small(asked):
        return train(replace(asked, changes=tuple(SMALL)))

    monkeypatch.setattr(commands, "train", small)
    monkeypatch.setattr(demo, "HDRIS", ("studio",))
    monkeypatch.setattr(demo, "VIEWS", ("test_000",))
    words = ("--size", "48", "--train", "10", "--test", "1", "--samples", "1", "--relight", "studio")
    scene = [sys.executable, "-m", "scripts.demo", demo.SCENE, "--out", out / "capture", *words]
    subprocess.run(list(map(str, scene)), cwd=clone_root(), check=True, capture_output=True)
    demo.run(out)
    run = out / "run"
    assert all((run / name).stat().st_size > 0 for name in ("mesh.glb", "jar.blend", "report.html"))
    relit = json.loads((run / "metrics.json").read_text())["relight"]["studio"]
    assert relit["splats"]["psnr_aligned"] > 5 and relit["mesh"]["psnr_aligned"] > 5
    with pytest.raises(InputError, match="holds a finished demo"):
        demo.run(out)
