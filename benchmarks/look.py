"""Compare pictures of runs with Cycles' pictures of the true scenes: `refgs bench look --scenes DIR --runs DIR`.

A run is drawn by the trainer's renderer, and in Blender as splats and as a mesh, under the light that it recovered and under other lights.
One contact sheet a scene has all pictures beside the true ones.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import Bench, Column, Table, call, console, find_scenes
from benchmarks.look_in_blender import DRAWN, RECOVERED, picture
from refgs.camera import Camera
from refgs.capture import read_capture
from refgs.compare import metrics
from refgs.compare.pictures import as_bytes, maps, over_white, write_png
from refgs.compare.truth import FOLDER, GroundTruth, read_relit
from refgs.formats.exr import write_exr
from refgs.paths import clone_environment, clone_root
from refgs.run import Run, open_run

RENDERER, OTHER = "renderer", "other"
VIEWS = 3
TABLES = (
    Table(
        "pictures against Cycles' of the true scenes",
        "look",
        (
            Column("recovered light: PSNR dB", "recovered_psnr", ".1f"),
            Column("aligned", "recovered_psnr_aligned", ".1f"),
            Column("FLIP", "recovered_flip", ".3f"),
            Column("other lights: PSNR dB", "other_psnr", ".1f"),
            Column("aligned", "other_psnr_aligned", ".1f"),
            Column("FLIP", "other_flip", ".3f"),
            Column("specks, of 1000 pixels", "other_specks", ".2f"),
            Column("ms a frame", "milliseconds", ".0f"),
        ),
        variant="drawn as",
    ),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the runs, compare the pictures with the truth, and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes --relight")
    parser.add_argument("--runs", type=Path, required=True, help="folder of finished runs, named as their scenes")
    parser.add_argument("--out", type=Path, help="folder for the pictures (default: demo/look)")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="measure these scenes")
    bench = Bench("look", parser, arguments)
    options = bench.options
    out = (options.out or clone_root() / "demo" / "look").resolve()
    for capture in find_scenes(options.scenes, options.only):
        folder = (options.runs / capture.name).resolve()
        if not (folder / "mesh.glb").exists() and call("export", folder) != 0:
            bench.failed.append(folder)
            continue
        measure(bench, capture, open_run(folder), out / capture.name)
        console.print(f"{capture.name}: {out / capture.name}.png")
    bench.finish(*TABLES)


def measure(bench: Bench, capture: Path, run: Run, out: Path) -> None:
    """Draw a run's held-out views under all lights that the capture has true pictures for. Add the errors to the rows of `bench`.

    Writes the pictures into the folder `out`, and a contact sheet beside it.
    """
    truth = GroundTruth(capture / FOLDER, run.to_capture)
    views = read_capture(capture, run.settings.region).test_views
    names = [views[i].camera.name for i in np.linspace(0, len(views) - 1, min(VIEWS, len(views))).round().astype(int)]
    cameras = [camera for camera in run.cameras if camera.name in names]
    out.mkdir(parents=True, exist_ok=True)
    panoramas = {hdri: truth.panorama(f"relight/{hdri}") for hdri in truth.hdris}
    milliseconds = draw_in_blender(run.folder, panoramas, names, out)
    draw(run, panoramas, cameras, out)
    rows, found = [], {}
    for light in (RECOVERED, *truth.hdris):
        true = [truth.color(camera) if light == RECOVERED else truth.relit(light, camera) for camera in cameras]
        rows += [[over_white(image)] for image in true]
        for drawn in (RENDERER, *DRAWN):
            pictures = [read_relit(picture(out, light, drawn, camera.name)) for camera in cameras]
            for row, image in zip(rows[-len(cameras) :], pictures, strict=True):
                row.append(over_white(image))
            pairs = list(zip(pictures, true, strict=True))
            found.setdefault((drawn, OTHER if light != RECOVERED else light), []).append(
                metrics.relit(lambda pairs=pairs: pairs, (metrics.psnr, metrics.flip, metrics.specks))
            )
    for (drawn, light), errors in found.items():
        mean = {name: float(np.mean([error[name] for error in errors])) for name in errors[0]}
        bench.record(
            capture.name, drawn, "dB",
            **{f"{light}_psnr": mean["psnr_raw"], f"{light}_psnr_aligned": mean["psnr_aligned"]},
        )  # fmt: skip
        bench.record(capture.name, drawn, "", **{f"{light}_flip": mean["flip_raw"]})
        bench.record(capture.name, drawn, "‰", **{f"{light}_specks": mean["specks_raw"]})
    for drawn, time in milliseconds.items():
        bench.record(capture.name, drawn, "ms", milliseconds=time)
    write_png(out.with_suffix(".png"), as_bytes(np.concatenate([np.concatenate(row, axis=1) for row in rows])))


def draw(run: Run, panoramas: dict[str, np.ndarray], cameras: list[Camera], out: Path) -> None:
    """Draw the views with the trainer's renderer, under the recovered light and the others."""
    lights = {RECOVERED: None} | {hdri: run.light(panorama) for hdri, panorama in panoramas.items()}
    for light, environment in lights.items():
        for camera in cameras:
            write_exr(picture(out, light, RENDERER, camera.name), maps(run.render(camera, environment))["color"])


def draw_in_blender(run: Path, panoramas: dict[str, np.ndarray], views: list[str], out: Path) -> dict[str, float]:
    """Draw the views in Blender, in a process of its own. Returns the median milliseconds of a frame, by how the run is drawn."""
    files = [out / f"{hdri}.exr" for hdri in panoramas]
    for file in files:
        write_exr(file, panoramas[file.stem])
    command = [sys.executable, "-m", "benchmarks.look_in_blender", run, "--out", out]
    command += ["--views", *views, "--hdri", *files]
    how = {"cwd": clone_root(), "env": clone_environment(), "capture_output": True, "text": True}
    done = subprocess.run(list(map(str, command)), **how)
    if done.returncode:
        raise RuntimeError(f"Blender did not draw {run}:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])
