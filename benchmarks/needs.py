"""What leaving out brings and costs, scene by scene: `refgs bench needs --scenes DIR`.

DIR holds captures with ground truth, as `python -m benchmarks.scenes all` makes them. Each is trained as the photos say (every need
"auto"), with everything on, and without inter-reflection. Seconds are those of the processor that iterations took: other work beside
hardly counts. Memory is the most that the process held. Runs lie in OUT/PRESET/WAY/SCENE: one that is finished is not trained again, one
that was interrupted goes on.
"""

import argparse
import json
from pathlib import Path

from rich.table import Table

from benchmarks import runs
from benchmarks.ablations import find_scenes
from benchmarks.runs import console, text
from refgs.paths import clone_root
from refgs.settings import NeedsSettings

WAYS = {
    "auto": (),
    "all on": (*(f"needs.{name}=on" for name in NeedsSettings.model_fields), "indirect.least=0"),
    "no reflections": ("needs.reflections=off",),
}


def without(run: Path) -> str:
    """What a run did without, by name."""
    rows = json.loads((run / "needs.json").read_text(encoding="utf-8"))
    return ", ".join(row["need"] for row in rows if not row.get("needed", True))


def deciding(run: Path) -> float:
    """Which part of a run's seconds it took to find out what it needs."""
    last = json.loads((run / "history.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    return last["parts"].get("deciding", 0.0) / last["seconds"]


def row(name: str, way: str, run: Path, beside: dict | None) -> list[str]:
    """The cells of a run; `beside` are the figures of the scene's run with everything on."""
    found = runs.figures(run)
    aligned = [light.get("refgs", {}).get("psnr_aligned") for light in found.get("relight", {}).values()]
    faster = None if beside is None else beside["processor_seconds"] / found["processor_seconds"]
    lost = None if beside is None else found["psnr"] - beside["psnr"]
    cells = [
        (found["processor_seconds"], ".0f"),
        (faster, ".2f"),
        (deciding(run), ".1%"),
        (found["psnr"], ".2f"),
        (lost, "+.2f"),
        (found.get("normal_mae_degrees"), ".1f"),
        (runs.mean(aligned), ".2f"),
        (found.get("peak_memory_bytes", 0) / 1e9, ".2f"),
        ((run / "splats.ply").stat().st_size / 1e6, ".1f"),
    ]
    return [name, way, *(text(value, form) for value, form in cells), without(run)]


def main(arguments: list[str] | None = None) -> None:
    """Train what is not trained yet, and print the table."""
    parser = argparse.ArgumentParser(prog="refgs bench needs", description="What leaving out brings and costs.")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder for the runs (default: demo/needs)")
    parser.add_argument("--preset", default="quick", help="a preset's name or a TOML file")
    parser.add_argument("--only", nargs="+", help="scenes, all where none is named")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=[*WAYS], help="all where none is named")
    options = parser.parse_args(arguments)
    out = (options.out or clone_root() / "demo" / "needs") / Path(options.preset).stem
    scenes = find_scenes(options.scenes, options.only)
    head = [
        "scene",
        "",
        "CPU s",
        "times as fast",
        "PSNR",
        "beside all on",
        "normals °",
        "relit, aligned",
        "GB",
        "PLY, MB",
        "without",
    ]
    table, failed = Table(*head, title=f"what scenes do without, {options.preset}"), []
    for scene in scenes:
        found = {}
        for way in options.ways:
            run = out / way.replace(" ", "_") / scene.name
            words = ["--preset", options.preset, *(word for change in WAYS[way] for word in ("--set", change))]
            if runs.measure(scene, run, words, truth=scene / "ground_truth"):
                found[way] = run
            else:
                failed.append(run)
        everything = runs.figures(found["all on"]) if "all on" in found else None
        for way, run in found.items():
            table.add_row(*row(scene.name, way, run, everything))
    console.print(table)
    runs.say_failed(failed)


if __name__ == "__main__":
    main()
