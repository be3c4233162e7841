"""How long Blender takes to import splats: `refgs bench importing`. Needs Blender's Python module.

A run of so many splats on a sphere, without mesh and light: Blender reading the file, how normals change across splats, and all of the
import; then the trainer's side, writing and reading splats with harmonics of the third degree. In seconds; the least of three.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.runs import console
from refgs.export.splats import Splats, read_splats, write_splats

COUNTS = 24_000, 100_000, 1_000_000


def sphere(count: int) -> Splats:
    """Splats all over a sphere, turned at random about its normals."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # From z to the normal, about an axis between them; as good as any, but at −z.
    rotation = np.column_stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(count)])
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    values = {
        "positions": normal,
        "normals": normal,
        "rotations": rotation,
        "scales": np.full((count, 2), 2 / np.sqrt(count)),
        "opacities": np.full(count, 0.9),
        "sh": np.zeros((count, 1, 3)),
        "albedo": rng.uniform(size=(count, 3)),
        "metallic": np.ones(count),
        "roughness": np.full(count, 0.1),
        "indirect": np.zeros((count, 0, 3)),
        "received": np.ones((count, 3)),
    }
    return Splats(**{name: value.astype(np.float32) for name, value in values.items()})


def timed(work, times: int = 3) -> float:
    """The least seconds of so many times."""
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def main() -> None:
    import bpy

    from refgs_addon.scene.import_run import import_run
    from refgs_addon.scene.splat_cloud import normal_slopes
    from refgs_addon.scene.splat_cloud import read_splats as read

    heads = "splats", "reading", "normals", "all of it", "the trainer's writing", "and reading"
    table = Table(*heads, title="seconds to import")
    with tempfile.TemporaryDirectory() as folder:
        for count in COUNTS:
            run = Path(folder) / str(count)
            run.mkdir()
            write_splats(run / "splats.ply", sphere(count))
            splats, _ = read(run / "splats.ply")
            rich, file = replace(sphere(count), sh=np.zeros((count, 16, 3), np.float32)), run / "rich.ply"

            def whole(run: Path = run) -> None:
                bpy.ops.wm.read_factory_settings(use_empty=True)
                import_run(run, bpy.context.scene)

            parts = (
                lambda run=run: read(run / "splats.ply"),
                lambda splats=splats: normal_slopes(splats),
                whole,
                lambda file=file, rich=rich: write_splats(file, rich),
                lambda file=file: read_splats(file),
            )
            table.add_row(f"{count:,}", *(f"{timed(part):.2f}" for part in parts))
    console.print(table)


if __name__ == "__main__":
    main()
