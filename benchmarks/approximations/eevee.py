"""In a process of its own, for Blender's clean-up has been seen to hang: `python -m benchmarks.approximations.eevee RUN OUT SIZE SAMPLES …`

renders the first view of a run's splats in Eevee with each number of samples, into OUT/SAMPLES.exr, and prints {samples: milliseconds} as
JSON; the processor's time, on all of its threads, for what draws without a card has its own.
"""

import json
import os
import sys
from pathlib import Path

import bpy

from benchmarks.approximations import timed
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show


def main(folder: Path, out: Path, size: int, samples: list[int]) -> None:
    printed = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Blender prints what it likes
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.eevee.use_shadows = False  # there are no lamps, and in software it is most of a frame's time
    run = import_run(folder, scene)
    show(run.collection, "splats")
    camera, spent = next(iter(run.cameras.values())), {}

    def render(count: int) -> None:
        render_preview(scene, out / f"{count}.png", camera, size, count, out / f"{count}.exr")

    render(1)  # which compiles the shaders
    for count in samples:
        spent[count] = timed(render, count, seconds=0)[1]
    print(json.dumps(spent), file=printed, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), [int(count) for count in sys.argv[4:]])
    sys.stderr.flush()
    os._exit(0)
