"""Samples of a preview in Eevee, against many times as many."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR

from benchmarks.approximations import Row, rms, room
from benchmarks.approximations.textures import sphere_of_splats
from benchmarks.scenes.analytic import camera_matrix
from refgs.color import srgb_encode
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from refgs.formats.splats import write_splats
from refgs.paths import clone_root


def write_run(folder: Path, splats: int, size: int) -> None:
    """What Blender imports of a run: a ball of splats, half metal, in a room with lamps, seen by one camera."""
    ball = sphere_of_splats(splats)
    ball.opacities[:] = np.random.default_rng(0).beta(0.6, 1.4, splats).clip(0.01, 0.99)
    write_splats(folder / "splats.ply", ball)
    light = room(directions(128, 256).reshape(-1, 3)).reshape(128, 256, 1)
    write_exr(folder / "environment.exr", np.repeat(light, 3, axis=2).astype(np.float32))
    frame = {"file_path": "images/view", "transform_matrix": camera_matrix(np.array([0.5, -1.0, 0.4])).tolist()}
    frame |= {"fl_x": 1.6 * size, "fl_y": 1.6 * size, "cx": size / 2, "cy": size / 2, "w": size, "h": size}
    cameras = {"frames": [frame | {"split": "test"}], "to_capture": np.eye(4).tolist()}
    (folder / "cameras.json").write_text(json.dumps(cameras), encoding="utf-8")


def samples(
    settings: tuple = (1, 4, 16, 64, 256), truth: int = 1024, splats: int = 4000, size: int = 128
) -> Iterator[Row]:
    """RMS error of the picture, sRGB-encoded over black, 0..1, from that of `truth` samples, whose own error is that of a fourth of them,
    halved: noise falls with the root of the samples."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_run(folder, splats, size)
        counts = [*settings, truth // 4, truth]
        command = [sys.executable, "-m", "benchmarks.approximations.eevee", folder, folder, size, *counts]
        done = subprocess.run(list(map(str, command)), cwd=clone_root(), capture_output=True, text=True)
        if done.returncode != 0:
            raise RuntimeError(f"Eevee did not render:\n{done.stderr}")
        spent = json.loads(done.stdout.splitlines()[-1])  # Blender 5.2 has its say before
        pictures = {}
        for count in counts:
            channels = OpenEXR.File(str(folder / f"{count}.exr")).channels()
            pixels = channels["RGBA"].pixels if "RGBA" in channels else np.dstack([channels[c].pixels for c in "RGBA"])
            pictures[count] = srgb_encode(pixels[..., :3].clip(0, 1))
    own = rms(pictures[truth // 4] - pictures[truth]) / 2
    for count in settings:
        error = rms(pictures[count] - pictures[truth])
        yield Row("Eevee's samples", "", count, error, "RMS error", spent[str(count)], count == 64, own)
