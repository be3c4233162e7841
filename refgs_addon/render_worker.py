"""A second Blender, without a window, that renders a copy of the file; `scene.beside` starts it. It speaks as the trainer's process does
(docs/job-protocol.md), and takes one command, {"command": "render", "png": …, "hdris": […], "size": …, "samples": …}: a contact sheet
under these lights, or the scene camera's view where there are none. It ends when its input does, so when the Blender that started it does.
"""

import json
import os
import sys
import threading
from pathlib import Path

from .errors import InputError
from .installation import end_with_input
from .jobs import PROTOCOL


def main() -> None:
    """Do what the one command says, and end the process."""
    events = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # Blender prints what it likes

    def say(event: str, **facts) -> None:
        events.write(json.dumps({"event": event, "job": "render"} | facts) + "\n")

    say("ready", protocol=PROTOCOL, refgs="")
    command = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_input, daemon=True).start()
    say("started")
    try:
        _render(command, say)
        say("done", png=command["png"])
    except InputError as error:
        say("failed", what=str(error), fault=False)
    except Exception as error:
        say("failed", what=f"a fault of ours: {type(error).__name__}: {error}", fault=True)
        raise
    finally:
        events.flush()
    os._exit(0)  # Blender's own clean-up at the end of a process has been seen to hang


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
