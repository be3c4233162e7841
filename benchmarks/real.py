"""Measure the method on captures of real objects: `refgs bench real --captures DIR`.

Each folder in DIR that has photos with cameras is trained, evaluated on its held-out views, exported and relit. The results are written
into a page with pictures. No true materials are known, so a person has to look: metal should be metal, and the mesh should be the object.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh

from benchmarks.harness import Bench, Column, Table, Variant, call, figures, find_captures, markdown_table
from refgs.camera import Camera
from refgs.capture import load_view, read_capture
from refgs.compare.pictures import as_bytes, composite, maps, picture
from refgs.errors import InputError
from refgs.formats.gltf import read_glb
from refgs.geometry.mesh import parts
from refgs.paths import clone_root, whole, write_text
from refgs.run import Run, open_run
from scripts.demo.light import read_light

SOLID = 0.5  # alpha from which a pixel shows the object
METAL = 0.8  # metallic from which a pixel shows metal
HEIGHT = 220  # pixels of each picture on the page
LIGHT = "sunset"  # Blender's HDRI for the relit picture
PASSES = ("photo", "rendered", "normals", "base colour", "metallic", "roughness", "relit", "mesh")
TABLES = (
    Table(
        "captures of real objects",
        "real",
        (
            Column("PSNR dB", "psnr", ".2f"),
            Column("exposure fitted", "psnr_exposure_fitted", ".2f"),
            Column("SSIM", "ssim", ".3f"),
            Column("normals °", "normals", ".2f"),
            Column("metal, of the object", "metal", ".0%"),
            Column("surfels", "surfels", ",.0f"),
            Column("mesh's pieces", "pieces", ".0f"),
            Column("s", "seconds", ".0f"),
            Column("CPU s", "processor_seconds", ".0f"),
            Column("GB", "memory", ".2f"),
        ),
        line="capture",
        variant="photos",
    ),
)
HEAD = """# Real captures

Machine: {machine}. Date: {date}. `refgs bench real --captures DIR` trains on each capture in a folder and writes this page.

PSNR and SSIM are means over held-out views, every eighth photo. A held-out photo's exposure is unknown: "exposure fitted" is the PSNR with
the exposure and white balance that fit best, if photos have their own. Metal is the part of the object's pixels in these views with a
metallic of at least {metal}. Normals are compared where a capture has ground truth, as rendered ones have. Seconds are those of the whole
command on the clock; CPU seconds are those of the iterations.

{table}

The pictures show a held-out view: {passes}. It is relit by Blender's `{light}`.
"""


def metal_part(run: Run) -> float | None:
    """Measure which part of the object's pixels in the held-out views has a metallic of at least METAL.

    Return None if the run has no materials or no held-out views.
    """
    shown = metal = 0
    for camera, split in zip(run.cameras, run.splits, strict=True):
        if split != "test":
            continue
        rendering = run.render(camera.fitted(run.settings.image.max_side))
        if rendering.material is None:
            return None
        solid = rendering.alpha > SOLID
        shown += int(solid.sum())
        metal += int((rendering.metallic[solid] >= METAL).sum())
    return metal / shown if shown else None


def count_pieces(mesh_file: Path) -> int:
    """Count the connected pieces of a mesh. Vertices at the same place count as one: textures have seams."""
    mesh = read_glb(mesh_file)
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    return len(parts(welded)[1])


def strip(run: Run) -> np.ndarray:
    """Make a row of pictures, uint8 (HEIGHT, W, 3), of the middle held-out view: those that PASSES names.

    All are cropped to the object. The mesh is drawn with its normals. Raise InputError if the capture has no held-out views.
    """
    views = read_capture(run.capture_folder, run.settings.region).test_views
    if not views:
        raise InputError(f"{run.capture_folder} has no test views")
    loaded = load_view(views[len(views) // 2], run.settings.image.max_side)
    rendering = run.render(loaded.camera)
    images, alpha = maps(rendering), rendering.alpha.numpy()

    def show(name: str) -> np.ndarray:
        value = picture(name, images[name], alpha)
        value = np.repeat(value[..., None], 3, axis=2) if value.ndim == 2 else value
        value[alpha <= SOLID] = 255
        return value

    pictures = [as_bytes(composite(loaded, torch.ones(3)).numpy()), as_bytes(rendering.color.clamp(0, 1).numpy())]
    pictures.append(show("normal"))
    if rendering.material is not None:
        pictures += [show(name) for name in ("albedo", "metallic", "roughness")]
        relit = run.render(loaded.camera, run.light(read_light(LIGHT)))
        pictures.append(as_bytes(relit.color.clamp(0, 1).numpy()))
    pictures.append(_draw_mesh(run, loaded.camera))
    rows, columns = (np.flatnonzero((alpha > SOLID).any(axis=axis)) for axis in (1, 0))
    if len(rows):
        pictures = [p[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] for p in pictures]
    width = max(1, round(pictures[0].shape[1] * HEIGHT / pictures[0].shape[0]))
    return np.concatenate([cv2.resize(p, (width, HEIGHT), interpolation=cv2.INTER_AREA) for p in pictures], axis=1)


def _draw_mesh(run: Run, camera: Camera) -> np.ndarray:
    """Draw the exported mesh's normals for a camera of the run, by rays through the pixels' centres: uint8 (H, W, 3)."""
    mesh = read_glb(run.folder / "mesh.glb")
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=-1)
    rays = local.reshape(-1, 3) @ camera.world_to_camera[:3, :3]
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    faces = shape.ray.intersects_first(np.broadcast_to(camera.position, rays.shape), rays)
    image = np.ones((len(rays), 3))
    image[faces >= 0] = shape.face_normals[faces[faces >= 0]] / 2 + 0.5
    return as_bytes(image.reshape(camera.height, camera.width, 3))


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and evaluate all captures that are not finished yet. Print a table, and write a page with pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=Path, required=True, help="folder of captures: photos with cameras")
    parser.add_argument("--out", type=Path, help="folder for the runs and the page (default: demo/real)")
    parser.add_argument("--only", nargs="+", default=[], metavar="CAPTURE", help="measure these captures")
    parser.add_argument("--preset", default="standard", help="a preset's name or a TOML file (standard)")
    parser.add_argument(
        "--side",
        type=int,
        nargs="+",
        default=[640],
        metavar="PIXELS",
        help="the photos' longer side (640); several to compare. Photos are not enlarged",
    )
    parser.set_defaults(variants=[])
    bench = Bench("real", parser, arguments)
    options = bench.options
    out = options.out or clone_root() / "demo" / "real"
    captures = find_captures(options.captures, options.only)
    sides = sorted(set(options.side))
    variants = {f"{n} px": Variant(("--preset", options.preset, "--set", f"image.max_side={n}")) for n in sides}
    sections = []
    for capture, runs in bench.runs(variants, captures):
        for variant, folder in runs.items():
            if not (folder / "mesh.glb").exists() and call("export", folder) != 0:
                bench.failed.append(folder)
                continue
            found, run = figures(folder), open_run(folder)
            fitted = found.get("psnr_exposure_fitted")
            bench.record(capture, variant, "dB", psnr=found["psnr"], psnr_exposure_fitted=fitted)
            bench.record(capture, variant, "", ssim=found["ssim"], surfels=found["splats"], metal=metal_part(run))
            bench.record(capture, variant, "°", normals=found.get("normal_mae_degrees"))
            bench.record(capture, variant, "", pieces=count_pieces(folder / "mesh.glb"))
            bench.record(
                capture, variant, "s", seconds=found["total_seconds"], processor_seconds=found["processor_seconds"]
            )
            if "peak_memory_bytes" in found:
                bench.record(capture, variant, "GB", memory=found["peak_memory_bytes"] / 1e9)
            if variant != f"{sides[-1]} px":  # the page shows the largest photos
                continue
            with whole(out / f"{capture}.jpg") as temporary:
                temporary.write_bytes(cv2.imencode(".jpg", strip(run)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1])
            sections.append(f"## {capture}\n\n![{', '.join(PASSES)}]({capture}.jpg)\n")
    if bench.rows:
        write_text(out / "real-captures.md", _page(bench, sections))
        print(out / "real-captures.md")
    bench.finish(*TABLES)


def _page(bench: Bench, sections: Sequence[str]) -> str:
    """Make the text of the page: how it was measured, the table, and a section for each capture."""
    table = markdown_table(TABLES[0].lines(bench.rows))
    machine, date, _ = bench.where
    head = HEAD.format(machine=machine, date=date, metal=METAL, table=table, passes=", ".join(PASSES), light=LIGHT)
    return "\n".join([head, *sections])
