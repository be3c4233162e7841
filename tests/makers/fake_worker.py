"""Imitate the trainer's process for tests of the add-on: read commands and answer with events, without training.

A word in the path of the photos chooses the behaviour: "crash" (end in the middle of the training), "noise" (also print lines that are no
events), "bare" (report photos without cameras), "unmasked" (make masks before a training), "slow", or "good" for none of them. If the
environment variable FAKE contains "newer", the trainer reports a newer version of the protocol.
"""

import json
import os
import sys
import threading
import time
import zlib
from pathlib import Path

from filelock import FileLock

waiting, kept = [], False


def say(event, **facts):
    try:
        print(json.dumps({"event": event} | facts), flush=True)
    except OSError:
        if not kept:
            raise


def train(command, asked):
    out = Path(command["out"])
    (out / "checkpoints").mkdir(parents=True, exist_ok=True)
    (out / "started").write_text(json.dumps(command))
    with FileLock(out / "run.lock"):
        learn(command, asked, out)


def learn(command, asked, out):
    paused, iteration = False, 0
    if "unmasked" in command["capture"]:
        say("progress", stage="carving", done=1, total=3)
        say("masks", what="made 3 masks", photos=3, made=3, kept=0, objects=1, **made_masks(command))
    say("decided", about="light", what="the light stands still: it brightens so")
    say("decided", about="metals", what="8% of the surface is metal", detail=True)
    say("stage", what="photos are in full size from now on", detail=True)
    while iteration < 1000:
        time.sleep(0.05 if "slow" in command["capture"] else 0.002)
        facts = {"iteration": iteration, "total": 1000, "seconds_left": 10 - iteration / 100}
        (out / "progress.tmp").write_text(json.dumps(facts))
        (out / "progress.tmp").replace(out / "progress.json")
        for other in [*asked(), *([{"command": "cancel"}] if (out / "stop").exists() else [])]:
            if other is None and kept:
                paused = False
                continue
            if other and other["command"] not in ("pause", "resume", "stop", "cancel", "preview"):
                waiting.append(other)
                continue
            if other is None or other["command"] == "cancel":
                (out / "checkpoints" / "00000010.toml").touch()
                return say("cancelled", job="train", run=str(out), iteration=iteration, seconds=1.0)
            paused = {"pause": True, "resume": False}.get(other["command"], paused)
            if other["command"] in ("pause", "resume"):
                say("paused" if paused else "resumed", iteration=iteration)
            if other["command"] == "stop":
                iteration = 1000
        if not paused and iteration < 1000:
            iteration += 10
            if "crash" in command["capture"] and iteration > 100:
                os._exit(3)
            facts |= {"iteration": iteration, "seconds": iteration / 100, "seconds_left": 10 - iteration / 100}
            say("progress", **facts, loss=0.1, psnr=20 + iteration / 100, splats=10)
            if iteration in (100, 1000):
                say("measured", iteration=iteration, seconds=iteration / 100, psnr_test=19 + iteration / 100)
            elif iteration == 500:  # a measurement without held-out views
                say("measured", iteration=iteration, seconds=iteration / 100)
    (out / "progress.json").unlink()
    (out / "splats.ply").touch()
    say("done", job="train", run=str(out), iteration=1000, seconds=10.0, psnr=30.0, left_out=[])


def made_masks(command):
    """Describe where the object is, and how masks move the frame."""
    box = ["region.centre=[1.0, 0.0, 0.0]", "region.size=[1.0, 2.0, 4.0]"]
    moved = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 1], [0, 0, 0, 1]]
    masks = {f"images/{photo.name}": f"masks/{photo.stem}.png" for photo in Path(command["capture"]).glob("images/*")}
    return {"capture": command["capture"], "region": box, "moved": moved, "masks": masks}


def hold(asked):
    """Wait until the input has ended."""
    while None not in (heard := asked()):
        time.sleep(0.002)
    return heard


def png(grey):
    """Make a PNG of one grey pixel."""
    chunks = (b"IHDR", b"\0\0\0\1\0\0\0\1\x08\0\0\0\0"), (b"IDAT", zlib.compress(bytes([0, grey]))), (b"IEND", b"")
    parts = (
        len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big") for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def check(command):
    """Answer the command `check`, which inspects a folder of photos: write two cameras and two small photos, and report them.

    The cameras are on opposite sides of the origin, four units away.
    """
    out, frames = Path(command["out"]), []
    out.mkdir(parents=True, exist_ok=True)
    for number, side in enumerate((1, -1)):
        (out / f"{number:04d}.png").write_bytes(png(100 * number))
        matrix = [[0, 0, side, 4 * side], [side, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
        lens = {"fl_x": 90.0, "fl_y": 90.0, "cx": 32.0, "cy": 32.0, "w": 64, "h": 64}
        frames.append({"file_path": f"images/{number}", "photo": f"{number}.png", "transform_matrix": matrix} | lens)
    (out / "cameras.json").write_text(json.dumps({"frames": frames}))
    files = {"cameras": str(out / "cameras.json"), "thumbnails": [str(out / "0000.png"), str(out / "0001.png")]}
    facts = {"centre": [0.0, 0.0, 0.0], "radius": 1.0, "lines": ["Views: 3", "Warning: they are dark"]}
    say("done", job="check", capture=command["capture"], **files, **facts)


def main():
    heard, lock = [], threading.Lock()

    def listen():
        global kept
        for line in sys.stdin:
            command = json.loads(line)
            if command["command"] == "keep":
                kept = command["on"]
                continue
            with lock:
                heard.append(command)
        with lock:
            heard.append(None)

    def asked():
        with lock:
            taken = heard[:]
            heard[:] = [None] if None in heard else []  # None, the end of the input, stays in the list
        return taken

    threading.Thread(target=listen, daemon=True).start()
    protocol = 2 if "newer" in os.environ.get("FAKE", "") else 1
    say("ready", protocol=protocol, refgs="9.9", card=None, no_card="it is a fake")
    while True:
        commands = waiting + asked()
        waiting.clear()
        for command in commands:
            if command is None:
                return
            say("started", job=command["command"])
            if command["command"] == "train":
                if "noise" in command["capture"]:
                    print('this is no JSON\n5\n{"event": "progress"}', flush=True)
                train(command, asked)
            elif command["command"] == "frames":
                for done in range(3):
                    say("progress", stage="frames", done=done, total=3, kept=done, blurred=1)
                if "slow" in command["video"]:
                    waiting.extend(hold(asked))
                    continue
                (Path(command["out"]) / "images").mkdir(parents=True)
                counts = {"frames": 3, "photos": command["count"], "blurred": 1, "duplicates": 2}
                say("done", job="frames", capture=command["out"], **counts)
            elif command["command"] == "masks":
                (Path(command["capture"]) / "asked").write_text(
                    json.dumps({key: command[key] for key in ("settings", "model")})
                )
                say("progress", stage="carving", done=1, total=3)
                say("done", job="masks", photos=3, made=2, kept=1, objects=1, **made_masks(command))
            elif command["command"] == "poses":
                for done in range(3):
                    say("progress", stage="matching", done=done, total=3)
                (Path(command["capture"]) / "sparse").mkdir()
                say("done", job="poses", placed=3, photos=3, error=0.5)
            elif command["command"] == "check":
                if "bare" in command["capture"] and not (Path(command["capture"]) / "sparse").exists():
                    say("failed", job="check", what="3 photos, but no cameras", fault=False, no_cameras=True)
                    continue
                check(command)
            elif file := command.get("display_splats"):
                say("progress", stage="colours", done=10, total=600)
                Path(file).write_text(command["run"])
                say("done", job="export", display_splats=file)
            else:
                (Path(command["run"]) / "mesh asked for").touch()
                say("progress", stage="mesh", done=40, total=100)
                say("failed", job=command["command"], what="the mesh is crumbs", fault=False)
        time.sleep(0.002)


main()
