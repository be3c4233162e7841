"""Import a run folder, save it as a .blend and render it under other lights, without a window.

    python -m refgs_addon.preview RUN --hdri A.exr --hdri B.exr --out DIR --blend FILE.blend [--views NAME …] [--size N]

This command renders the splats and the mesh from each view under each HDRI, into DIR/HDRI_{splats,mesh}_VIEW.png and .exr. It prints one
JSON object a line: {"event": "progress", "done": 1, "total": 8, "what": "…"}, and at the end {"event": "done", "files": […]}.
If the input or a system library is missing, it prints one line to stderr and exits with status 2.
"""

import argparse
import ctypes
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

from .errors import InputError

# Blender links against these; Mesa renders Eevee's pictures on machines without a screen or GPU.
APT = (
    "apt-get install libegl1 libgl1 libgl1-mesa-dri libsm6 libxext6 libxfixes3 libxi6 libxkbcommon0 libxrender1"
    " (Debian 12 and later, Ubuntu 22.04 and later)"
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="refgs_addon.preview", description="Render a run in Blender under other lights."
    )
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument(
        "--hdri", type=Path, action="append", required=True, help="panorama to light the run with; may be repeated"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--blend", type=Path, required=True, help=".blend to save")
    parser.add_argument("--views", nargs="+", help="views to render, by photo name; default: the first")
    parser.add_argument("--size", type=int, help="longer side in pixels; default: the photo's")
    options = parser.parse_args(arguments)
    try:
        check_libraries()
        preview(options)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def preview(options: argparse.Namespace) -> None:
    # Blender and its add-ons print to stdout, even while they load: send that to stderr, so that only events are on stdout.
    events = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    import bpy

    from .scene.import_run import import_run
    from .scene.render_eevee import render_preview
    from .scene.run_parts import show
    from .scene.world_light import relight

    def say(**event) -> None:
        print(json.dumps(event), file=events)

    for hdri in options.hdri:
        if not hdri.is_file():
            raise InputError(f"there is no light {hdri}: choose an EXR or HDR panorama")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    say(event="progress", done=0, total=0, what=f"importing {options.run}")
    run = import_run(options.run, scene)
    if not run.cameras:
        raise InputError(f"{options.run} has no cameras.json: there is no view to render")
    views = options.views or [next(iter(run.cameras))]
    if unknown := [view for view in views if view not in run.cameras]:
        raise InputError(f"{options.run} has no view {unknown[0]}: it has {', '.join(list(run.cameras)[:5])} …")
    bpy.ops.file.pack_all()
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        options.blend.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(options.blend.resolve()), compress=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"cannot write {options.blend} and {options.out}: {str(error).strip()}") from None

    # There are no lamps, so no shadows; software Eevee spends most of a frame on preparing for them.
    scene.eevee.use_shadows = False
    shown = ["splats", "mesh"] if run.mesh else ["splats"]
    total, files = len(options.hdri) * len(shown) * len(views), []
    for hdri in options.hdri:
        relight(scene, hdri)
        for part in shown:
            show(run.collection, part)
            for view in views:
                path = options.out / f"{hdri.stem}_{part}_{view}.png"
                say(event="progress", done=len(files), total=total, what=f"{view}: {part} under {hdri.stem}")
                render_preview(scene, path, run.cameras[view], options.size, exr=path.with_suffix(".exr"))
                files.append(str(path))
    say(event="progress", done=total, total=total, what="rendered")
    say(event="done", files=files, blend=str(options.blend))


def check_libraries() -> None:
    """Raise InputError if this machine lacks a system library that Blender needs. The error names all missing libraries.

    Blender's Python module needs the X libraries to load. Eevee loads EGL for its first picture, and without EGL the process dies.
    """
    spec = importlib.util.find_spec("bpy")
    if spec is None:
        raise InputError("Blender's Python module is not installed: pip install bpy")
    if sys.platform != "linux":
        return
    missing = []
    binary = next(Path(spec.origin).parent.glob("__init__*.so"), None)
    if binary is not None:
        listing = subprocess.run(["ldd", str(binary)], capture_output=True, text=True, check=False).stdout
        missing += re.findall(r"(\S+) => not found", listing)
    for name in ("libEGL.so.1", "libGL.so.1"):
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    if missing:
        raise InputError(f"Blender cannot start without {', '.join(sorted(set(missing)))}: {APT}")


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # Blender's own clean-up at exit can hang
