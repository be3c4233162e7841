"""Render a copy of the open .blend in a second Blender without a window. `scene.render_process` starts this program.

It reads one command from stdin, {"command": "render", "png": …, "hdris": […], "size": …, "samples": …}, and prints events to stdout
(docs/job-protocol.md). With HDRIs it renders a contact sheet: the view under each light. Without HDRIs it renders the scene camera's view.
It exits when stdin closes, so that it never outlives the first Blender.
"""

import json
import os
import sys
import threading
from pathlib import Path

from .errors import InputError
from .installation import exit_with_stdin
from .jobs import PROTOCOL


def main() -> None:
    """Read one command from stdin, run it, and end the process."""
    events = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # Blender prints to stdout: only events may go there

    def say(event: str, **facts) -> None:
        events.write(json.dumps({"event": event, "job": "render"} | facts) + "\n")

    say("ready", protocol=PROTOCOL, refgs="")
    command = json.loads(sys.stdin.readline())
    threading.Thread(target=exit_with_stdin, daemon=True).start()
    say("started")
    try:
        _render(command, say)
        say("done", png=command["png"])
    except InputError as error:
        say("failed", what=str(error), fault=False)
    except Exception as error:
        say("failed", what=f"internal error: {type(error).__name__}: {error}", fault=True)
        raise
    finally:
        events.flush()
    os._exit(0)  # Blender's own clean-up at exit can hang


def _render(command: dict, say) -> None:
    import bpy

    from .scene.contact_sheet import contact_sheet
    from .scene.render_eevee import render_preview

    png, hdris = Path(command["png"]), [Path(hdri) for hdri in command["hdris"]]
    look = {"size": command["size"], "samples": command["samples"]}
    if not hdris:
        say("stage", what=f"Rendering {png.name}", part=0.0)
        render_preview(bpy.context.scene, png, **look)
        return

    def progress(done: int, what: str) -> None:
        say("stage", what=f"Under {what}", part=done / (len(hdris) + 1))

    contact_sheet(bpy.context.scene, png, hdris, progress=progress, **look)
