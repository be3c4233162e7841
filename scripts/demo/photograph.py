"""Run the command that photographs an object: `NAME --out DIR` renders photos and ground truth into the new folder DIR.

With `all` in place of NAME, each object is rendered into DIR/NAME.

Progress goes to standard output as JSON lines: {"event": "progress", "done": 3, "total": 104, "what": "train views"}. Blender's own
messages go to standard error. Wrong input ends the command with one line of explanation and exit status 2.
"""

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from refgs.errors import InputError
from scripts.demo.shapes import Scene


def main(program: str, scenes: dict[str, Callable[[], Scene]]) -> None:
    """Parse the command line, photograph the object that it names, and end the process.

    `program` is the program's name for the help. `scenes` maps the names of objects to functions that build them.
    """
    status = _run(program, scenes)
    sys.stderr.flush()
    os._exit(status)  # Blender sometimes hangs when it cleans up at the end of a process


def _run(program: str, scenes: dict[str, Callable[[], Scene]]) -> int:
    parser = argparse.ArgumentParser(prog=f"python -m {program}", description="Photograph an object by Cycles.")
    help = f"{', '.join(scenes)}; all: those that DIR doesn't hold yet"
    parser.add_argument("name", choices=[*scenes, "all"], metavar="NAME", help=help)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--size", type=int, default=256, help="width and height in pixels (256)")
    parser.add_argument("--train", type=int, default=80, help="training views (80)")
    parser.add_argument("--test", type=int, default=8, help="held-out views, which get ground truth (8)")
    parser.add_argument("--samples", type=int, default=16, help="Cycles samples a pixel, before denoising (16)")
    parser.add_argument("--relight", nargs="*", default=[], metavar="HDRI", help="Blender's HDRIs by name")
    options = parser.parse_args()

    # Blender prints to file descriptor 1. Events use a copy of it; descriptor 1 itself becomes standard error.
    events = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    # A signal is obeyed after the current view, so that the half-written folder is removed: Blender hangs when an exception leaves
    # one of its callbacks.
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: ended.append(number))

    captures = {options.name: options.out}
    if options.name == "all":
        captures = {name: options.out / name for name in scenes if not (options.out / name).exists()}

    def progress(done: int, total: int, what: str) -> None:
        if ended:
            raise InterruptedError
        done, total = done + total * list(captures).index(name), total * len(captures)
        what = f"{name}: {what}" if options.name == "all" else what
        print(json.dumps({"event": "progress", "done": done, "total": total, "what": what}), file=events)

    from scripts.demo.capture import write_capture  # import only now, with redirected output: importing bpy may print

    numbers = (options.size, options.train, options.test, options.samples)
    try:
        for name, out in captures.items():
            write_capture(scenes[name](), out, *numbers, options.relight, progress)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except InterruptedError:
        return 128 + ended[0]
    return 0
