"""`python -m benchmarks.scenes NAME --out DIR`: render a capture with ground truth; `all` renders each into DIR/NAME.

Standard output carries JSON lines: {"event": "progress", "done": 3, "total": 104, "what": "train views"}; Blender's own
chatter goes to standard error. Exit status 2 and one line: the input is wrong.
"""

import argparse
import json
import os
import signal
import sys
from pathlib import Path

from benchmarks.scenes import MATTE, NAMES, REFLECTIVE, build
from refgs.errors import InputError


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scenes", description=__doc__.split("\n")[0])
    kinds = f"reflective: {', '.join(REFLECTIVE)}; matte: {', '.join(MATTE)}; all: those that DIR doesn't hold yet"
    parser.add_argument("name", choices=[*NAMES, "all"], metavar="NAME", help=kinds)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--size", type=int, default=256, help="pixels, of both sides (256)")
    parser.add_argument("--train", type=int, default=80, help="training views (80)")
    parser.add_argument("--test", type=int, default=8, help="held-out views, which get ground truth (8)")
    parser.add_argument("--samples", type=int, default=16, help="Cycles samples a pixel, before denoising (16)")
    parser.add_argument("--relight", nargs="*", default=[], metavar="HDRI", help="Blender's HDRIs by name")
    options = parser.parse_args()

    # Blender prints to the file descriptor, so it is the descriptor that has to be moved out of the way.
    events = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    # Ended from outside, it still removes its half-written folder; after the view at hand, for Blender hangs when an
    # exception leaves one of its callbacks.
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: ended.append(number))

    captures = {options.name: options.out}
    if options.name == "all":
        captures = {name: options.out / name for name in NAMES if not (options.out / name).exists()}

    def progress(done: int, total: int, what: str) -> None:
        if ended:
            raise InterruptedError
        done, total = done + total * list(captures).index(name), total * len(captures)
        what = f"{name}: {what}" if options.name == "all" else what
        print(json.dumps({"event": "progress", "done": done, "total": total, "what": what}), file=events)

    from benchmarks.scenes.capture import write_capture  # after the descriptor: importing bpy may print too

    numbers = (options.size, options.train, options.test, options.samples)
    try:
        for name, out in captures.items():
            write_capture(build(name), out, *numbers, options.relight, progress)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except InterruptedError:
        return 128 + ended[0]
    return 0


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # Blender's own clean-up at the end of a process has been seen to hang
