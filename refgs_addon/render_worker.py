"""Work in a second Blender without a window. `scene.render_process` starts this program.

It reads one command from stdin and prints events to stdout (docs/job-protocol.md). It exits when stdin closes, so that it never outlives
the first Blender. The commands:

- {"command": "render", "png": …, "hdris": […], "size": …, "samples": …} renders the .blend that is open. With HDRIs it renders a contact
  sheet: the view under each light. Without HDRIs it renders the scene camera's view.
- {"command": "library", "folder": …, "runs": [{"name": …, "picture": …}]} saves runs as Blender assets. `folder` holds the runs of a batch,
  the training of many captures.
"""

import json
import os
import sys
import threading
from pathlib import Path

from .errors import InputError, missing_module
from .jobs import PROTOCOL


def main() -> None:
    """Read one command from stdin, run it, and end the process."""
    events = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # Blender prints to stdout: only events may go there

    def say(event: str, **facts) -> None:
        events.write(json.dumps({"event": event} | facts) + "\n")

    say("ready", protocol=PROTOCOL, refgs="")
    command = json.loads(sys.stdin.readline())
    job = command["command"]
    threading.Thread(target=_exit_with_stdin, daemon=True).start()
    say("started", job=job)
    try:
        facts = {"render": _render, "library": _library}[job](command, say)
        say("done", job=job, **facts)
    except InputError as error:
        say("failed", job=job, what=str(error), fault=False)
    except ModuleNotFoundError as error:
        say("failed", job=job, what=missing_module(error), fault=False)
    except Exception as error:
        say("failed", job=job, what=f"internal error: {type(error).__name__}: {error}", fault=True)
        raise
    finally:
        events.flush()
    os._exit(0)  # Blender's own clean-up at exit can hang


def _exit_with_stdin() -> None:
    sys.stdin.read()
    os._exit(1)


def _render(command: dict, say) -> dict:
    import bpy

    from .scene.contact_sheet import contact_sheet
    from .scene.render_eevee import render_preview

    png, hdris = Path(command["png"]), [Path(hdri) for hdri in command["hdris"]]
    look = {"size": command["size"], "samples": command["samples"]}
    if not hdris:
        say("stage", what=f"Rendering {png.name}", part=0.0)
        render_preview(bpy.context.scene, png, **look)
        return {"png": command["png"]}

    def progress(done: int, what: str) -> None:
        say("stage", what=f"Under {what}", part=done / (len(hdris) + 1))

    contact_sheet(bpy.context.scene, png, hdris, progress=progress, **look)
    return {"png": command["png"]}


def _library(command: dict, say) -> dict:
    from .scene.asset_library import LIBRARY, add_catalog, asset_file, write_asset

    folder, runs = Path(command["folder"]), command["runs"]
    try:
        (folder / LIBRARY).mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder / LIBRARY}: the folder cannot be made ({error.strerror})") from None
    add_catalog(folder / LIBRARY)
    failed = []
    for number, run in enumerate(runs):
        say("stage", what=run["name"], part=number / len(runs))
        try:
            picture = Path(run["picture"]) if run["picture"] else None
            write_asset(folder / run["name"], picture, asset_file(folder, run["name"]))
        except InputError as error:  # of this run: the others may be whole
            failed.append(f"{run['name']}: {error}")
    return {"written": len(runs) - len(failed), "failed": failed}
