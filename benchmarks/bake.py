"""What a mesh's textures are worth, there and back: `refgs bench bake --scenes DIR --runs DIR`.

SCENES holds captures with ground truth, as `python -m benchmarks.scenes all` makes them, RUNS a finished run of each under the scene's
name. Each run's mesh is exported into OUT/SCENE, in a process of its own, and rendered by Cycles from the held-out views, under the
recovered light and under another. Prints how near that comes to the photos, beside what the splats' own renderer shows of the same views;
where the mesh is behind; and what the export took. The pictures lie in OUT/SCENE/pictures: photo, splats, mesh; truth, splats, mesh.
"""

import argparse
import json
import os
from pathlib import Path

import bpy
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.ndimage import binary_dilation, binary_opening

from benchmarks.ablations import find_scenes
from benchmarks.exporting import export
from benchmarks.runs import mean, text
from benchmarks.scenes.cycles import Renderer
from refgs.camera import Camera
from refgs.color import srgb_encode
from refgs.compare import metrics
from refgs.compare.pictures import as_bytes, maps, over_white, write_png
from refgs.compare.truth import GroundTruth, read_relit
from refgs.errors import InputError
from refgs.paths import clone_root
from refgs.render.renderer import render
from refgs.run import Run, open_run

SAMPLES = 16  # of Cycles, denoised; see `Renderer`
BRUSH = 9  # pixels across: what a disc of this size cannot lie in is thin
REGIONS = ("thin", "outline", "in itself", "rest", "outside")
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Baked(Renderer):
    """Renders a mesh.glb as Blender imports it."""

    def __init__(self, path: Path, size: int):
        self._path = path
        super().__init__(None, (), size, SAMPLES)

    def _object(self, mesh, materials) -> None:
        bpy.ops.import_scene.gltf(filepath=str(self._path))

    def view(self, camera: Camera) -> np.ndarray:
        """Premultiplied linear RGBA."""
        return self.render(camera.camera_to_world @ _OPENGL, seed=0)["color"]


def regions(alpha: np.ndarray, visibility: np.ndarray) -> dict[str, np.ndarray]:
    """Masks (h, w) that part a picture by what the object is there, from its true alpha and visibility (h, w)."""
    covered = alpha > metrics.COVERED
    y, x = np.mgrid[:BRUSH, :BRUSH] - BRUSH // 2
    masks = {
        "thin": covered & ~binary_opening(covered, x * x + y * y <= (BRUSH / 2) ** 2),
        "outline": binary_dilation((alpha > 0.01) & (alpha < 0.99), np.ones((3, 3))),
        "in itself": covered & (visibility < 0.5),
        "rest": covered,
        "outside": np.ones_like(covered),
    }
    left = np.ones_like(covered)
    for name, mask in masks.items():
        masks[name] = mask & left
        left &= ~mask
    return masks


def measure(run: Run, truth: GroundTruth, mesh: Path, views: int, hdri: str, pictures: Path) -> dict[str, float]:
    """PSNR in dB, mean over views: of `splats`, of `without` what they add by direction, of the `mesh`; under the other light, raw
    and aligned; and of either by region, over the views together."""
    cameras = [c for c, split in zip(run.cameras, run.splits, strict=True) if split == "test"]
    cameras = [
        cameras[i].fitted(run.settings.image.max_side) for i in np.linspace(0, len(cameras) - 1, views).astype(int)
    ]
    renderer = Baked(mesh, cameras[0].width)
    background = np.array(run.settings.image.background, np.float32)

    def encoded(pixels: np.ndarray) -> np.ndarray:
        """As photos are written: clipped, encoded, then over the background."""
        alpha = pixels[..., 3:]
        straight = srgb_encode(pixels[..., :3] / np.maximum(alpha, 1e-6)).clip(0, 1)
        return straight * alpha + (1 - alpha) * background

    rows: dict[str, list[float]] = {}
    squares = {name: np.zeros(3) for name in REGIONS}
    renderer.set_light(run.folder / "environment.exr")
    for camera in cameras:
        photo = encoded(read_relit(truth.folder / "color" / f"{camera.name}.exr", (camera.height, camera.width)))
        with torch.no_grad():
            plain = render(
                run.surfels().without_directions(),
                run.environment,
                camera,
                torch.tensor(run.settings.image.background),
                run.settings.render,
                run.near,
                run.occluder,
            )
        shown = {
            "splats": run.render(camera).color.numpy().clip(0, 1),
            "without": plain.color.numpy().clip(0, 1),
            "mesh": encoded(renderer.view(camera)),
        }
        for name, image in shown.items():
            rows.setdefault(name, []).append(metrics.psnr(image, photo))
        parts = regions(truth.view("alpha", camera), truth.view("visibility", camera))
        for name, mask in parts.items():
            errors = [((shown[kind][mask] - photo[mask]) ** 2).mean(-1).sum() for kind in ("without", "mesh")]
            squares[name] += [mask.sum(), *errors]
        write_png(pictures / f"{camera.name}.png", as_bytes(np.hstack([photo, shown["splats"], shown["mesh"]])))

    renderer.set_light(truth.folder / "relight" / f"{hdri}.exr")
    light = run.light(truth.panorama(f"relight/{hdri}"))
    true = [truth.relit(hdri, camera) for camera in cameras]
    relit = {
        "splats": [maps(run.render(camera, light))["color"] for camera in cameras],
        "mesh": [renderer.view(camera) for camera in cameras],
    }
    for name, images in relit.items():
        figures = metrics.relit(lambda images=images: zip(images, true, strict=True))
        rows |= {f"{name}_relit": [figures["psnr_raw"]], f"{name}_aligned": [figures["psnr_aligned"]]}
    for camera, *images in zip(cameras, true, relit["splats"], relit["mesh"], strict=True):
        write_png(pictures / f"{hdri}_{camera.name}.png", as_bytes(np.hstack([over_white(image) for image in images])))

    found = {name: float(np.mean(values)) for name, values in rows.items()}
    total = sum(squares.values())
    for name, (count, *errors) in squares.items():
        found[f"{name}_share"] = count / total[0]
        # What a region adds to the mesh's mean error: these add up to all that it is behind.
        found[f"{name}_behind"] = (errors[1] - errors[0]) / total[2]
        for kind, error in zip(("splats", "mesh"), errors, strict=True):
            found[f"{name}_{kind}"] = metrics.decibels(error / max(count, 1))
    return found


def main(arguments: list[str] | None = None) -> None:
    """Measure what is there and print the tables."""
    parser = argparse.ArgumentParser(prog="refgs bench bake", description="A mesh's textures, there and back.")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--runs", type=Path, required=True, help="folder of finished runs, one a scene")
    parser.add_argument("--out", type=Path, default=None, help="folder for the meshes (default: demo/bake)")
    parser.add_argument("--only", nargs="+", default=None, metavar="SCENE", help="of the scenes, these")
    parser.add_argument("--texture", type=int, default=2048, help="side of the textures, in pixels")
    parser.add_argument("--views", type=int, default=4, help="held-out views to render")
    parser.add_argument("--hdri", default="city", help="the other light")
    options = parser.parse_args(arguments)
    printed = Console(file=os.fdopen(os.dup(1), "w"), soft_wrap=True, width=200)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Blender reports each sample
    out = options.out or clone_root() / "demo" / "bake"
    found, exported = {}, {}
    for scene in find_scenes(options.scenes, options.only):
        run = open_run(options.runs / scene.name)
        if run.environment is None:
            raise InputError(f"{run.folder} was trained with shading = sh: it has no materials to bake")
        folder = out / scene.name
        folder.mkdir(parents=True, exist_ok=True)
        exported[scene.name] = export(run.folder, folder / "mesh.glb", options.texture)
        truth = GroundTruth(scene / "ground_truth", run.to_capture)
        found[scene.name] = measure(run, truth, folder / "mesh.glb", options.views, options.hdri, folder / "pictures")
        both = {"figures": found[scene.name], "export": exported[scene.name]}
        (folder / "bake.json").write_text(json.dumps(both, indent=1), encoding="utf-8")
    _print(printed, found, exported, options.hdri)


def _print(console: Console, found: dict[str, dict[str, float]], exported: dict[str, dict], hdri: str) -> None:
    columns = {
        "splats": "splats",
        "without residual": "without",
        "mesh": "mesh",
        f"splats, {hdri}": "splats_relit",
        f"mesh, {hdri}": "mesh_relit",
        "splats, aligned": "splats_aligned",
        "mesh, aligned": "mesh_aligned",
    }
    table = Table("scene", title="PSNR over held-out views, dB; without what splats add by direction")
    for heading in columns:
        table.add_column(heading, justify="right")
    for name, figures in found.items():
        table.add_row(
            name, *(text(figures[key], ".2f") for key in columns.values()), end_section=name == list(found)[-1]
        )
    means = [mean([figures[key] for figures in found.values()]) for key in columns.values()]
    table.add_row("mean", *(text(value, ".2f") for value in means))
    console.print(table)

    table = Table(
        "scene",
        title="where: share of pixels; dB there of splats without, of the mesh; part of the mesh's error that is more",
    )
    for name in REGIONS:
        table.add_column(name, justify="right")
    for scene, f in found.items():
        cells = [
            f"{f[f'{r}_share']:.0%}  {f[f'{r}_splats']:.1f} {f[f'{r}_mesh']:.1f}  {f[f'{r}_behind']:+.0%}"
            for r in REGIONS
        ]
        table.add_row(scene, *cells)
    console.print(table)

    for scene, facts in exported.items():
        steps = "; ".join(f"{what} {seconds:.1f} ({used:.1f})" for what, seconds, used in facts["steps"])
        total, processor = (sum(step[i] for step in facts["steps"]) for i in (1, 2))
        memory = max(m or 0 for m in facts["memory"]) / 1e9
        console.print(f"{scene}: {total:.0f} s ({processor:.0f} s of the processor), {memory:.2f} GB at most: {steps}")


if __name__ == "__main__":
    main()
