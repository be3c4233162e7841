"""Draw a run in Blender as `benchmarks.look` asks: splats in Eevee, and the mesh in Eevee and in Cycles.

The last line on stdout is a JSON object with the median milliseconds of a frame, by how the run is drawn.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

SPLATS, MESH, TRACED = "splats, Eevee", "mesh, Eevee", "mesh, Cycles"
DRAWN = (SPLATS, MESH, TRACED)
RECOVERED = "recovered"  # the light


def picture(out: Path, light: str, drawn: str, view: str) -> Path:
    """Return the file of a view's picture under a light, in premultiplied linear RGBA."""
    return out / f"{light}_{drawn.replace(' ', '_')}_{view}.exr"


def main() -> None:
    """Draw all views under all lights. The first picture of each kind is not timed, as Blender compiles shaders then."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", nargs="+", required=True)
    parser.add_argument("--hdri", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Blender prints to stdout

    import bpy

    from refgs_addon import compat
    from refgs_addon.scene.import_run import import_run
    from refgs_addon.scene.render_eevee import render_preview
    from refgs_addon.scene.run_parts import show
    from refgs_addon.scene.world_light import relight
    from scripts.demo.cycles import let_light_leave

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.eevee.use_shadows = (
        False  # there are no lamps, and software Eevee spends most of a frame on preparing for them
    )
    scene.cycles.samples = 64  # as many as Eevee's
    let_light_leave(scene)
    run = import_run(options.run, scene)
    times = {drawn: [] for drawn in DRAWN}
    for hdri in (None, *options.hdri):
        relight(scene, hdri)
        for drawn in DRAWN:
            show(run.collection, drawn.split(",")[0])
            engine = "CYCLES" if drawn == TRACED else compat.EEVEE
            for view in options.views:
                at = time.perf_counter()
                exr = picture(options.out, hdri.stem if hdri else RECOVERED, drawn, view)
                render_preview(scene, exr.with_suffix(".png"), run.cameras[view], exr=exr, engine=engine)
                times[drawn].append(1e3 * (time.perf_counter() - at))
    print(json.dumps({drawn: statistics.median(spent[1:]) for drawn, spent in times.items()}), file=answer, flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)  # Blender's own clean-up at exit can hang
