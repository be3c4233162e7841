"""Meshes against the true ones, by voxel size: `refgs bench meshing --runs DIR --scenes DIR`.

RUNS/SCENE are finished runs of SCENES/SCENE, captures with ground truth as `python -m benchmarks.scenes all` makes them, which `refgs
bench truth` trains. Prints, by scene and resolution: seconds of fusing and cleaning, the memory that they needed beside what was there,
and how far the mesh is from the true one, all of it and simplified to the run's budget of triangles.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
import trimesh
from rich.table import Table

from benchmarks.runs import console

RESOLUTIONS = (64, 128, 256, 512)
HEADINGS = (
    "across",
    "fuse s",
    "clean s",
    "GB",
    "triangles",
    "Chamfer %",
    "normals",
    "to",
    "Chamfer %",
    "normals",
    "parts",
    "open %",
    "bad",
)


def measure(folder: Path, truth: Path, resolution: int) -> list[str]:
    """A row of the table, beginning with `resolution`; in a process of its own, whose peak memory is that of this alone."""
    from refgs.compare.surface import compare
    from refgs.compare.truth import GroundTruth
    from refgs.geometry.mesh import clean
    from refgs.jobs import peak_memory
    from refgs.render.extract import extract
    from refgs.run import open_run

    run = open_run(folder)
    cameras, true = run.training_cameras(), GroundTruth(truth, run.to_capture).mesh()
    surfels = run.surfels()
    before, begun = peak_memory(), perf_counter()
    mesh, _ = extract(surfels, cameras, run.near, run.centre, run.radius, resolution)
    fused = perf_counter()
    small = clean(mesh, run.settings.mesh.triangles)
    ended, memory = perf_counter(), peak_memory() - before
    row = [resolution, f"{fused - begun:.1f}", f"{ended - fused:.1f}", f"{memory / 1e9:.2f}"]
    for one in (clean(mesh, len(mesh.faces)), small):
        found = compare(one, true, cameras)
        row += [f"{len(one.faces):,}", f"{100 * found['chamfer']:.3f}", f"{found['normal_consistency']:.4f}"]
    return [str(cell) for cell in row + topology(small)]


def topology(mesh) -> list[str]:
    """Connected parts; the part of the edges that one face has, and how many three or more have."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, faces = np.unique(solid.edges_sorted, axis=0, return_counts=True)
    return [str(solid.body_count), f"{100 * (faces == 1).mean():.2f}", str((faces > 2).sum())]


def main() -> None:
    parser = argparse.ArgumentParser(prog="refgs bench meshing", description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, help="folder of finished runs, named as their scenes")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures with ground truth")
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS, help="voxels across")
    options = parser.parse_args()
    from benchmarks.meshing import measure  # by a name that another process knows it by

    for scene in sorted(folder.name for folder in options.scenes.iterdir()):
        if not (options.runs / scene / "splats.ply").exists():
            continue
        table = Table(*HEADINGS, title=scene)
        for resolution in options.resolutions:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
                job = alone.submit(measure, options.runs / scene, options.scenes / scene / "ground_truth", resolution)
                table.add_row(*job.result())
        console.print(table)


if __name__ == "__main__":
    main()
