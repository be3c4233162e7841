"""What a training makes of a given time: `refgs bench minutes --scenes DIR`.

DIR holds captures with ground truth, as `python -m benchmarks.scenes all` makes them. Each is trained by the presets `quick` and
`standard`, and with nothing but a time, for each of them. Prints when that ended, with its asset written, beside when it was to; its
PSNR on held-out views; and beside that the best that a preset has had by then, on the way or at its end, start and asset counted. Runs
lie in OUT/PRESET|TIME/SCENE: one that is finished is not trained again, one that was interrupted goes on.
"""

import argparse
import json
from pathlib import Path

from rich.table import Table

from benchmarks import runs
from benchmarks.ablations import find_scenes
from benchmarks.runs import console
from refgs.formats import history
from refgs.paths import clone_root

PRESETS = "quick", "standard"
HEADINGS = "scene", "trained by", "ended after", "iterations", "surfels", "PSNR", "presets by then", "of", "ahead by"


def course(run: Path) -> list[tuple[float, float]]:
    """Seconds since the command was given, with what comes after the iterations, and PSNR on held-out views by then."""
    found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    around = found["total_seconds"] - found["training_seconds"]
    lines = history.read((run / history.FILE).read_text(encoding="utf-8"))
    return [(line["seconds"] + around, line["psnr_test"]) for line in lines if "psnr_test" in line]


def best(presets: dict[str, Path], seconds: float) -> tuple[float, str] | None:
    """The best PSNR that any of the presets' runs had by then, and which; None where none had begun."""
    reached = [(psnr, name) for name, run in presets.items() for at, psnr in course(run) if at <= seconds]
    return max(reached, default=None)


def main(arguments: list[str] | None = None) -> None:
    """Train what is not trained yet, and print the table."""
    parser = argparse.ArgumentParser(prog="refgs bench minutes", description="What a training makes of a given time.")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder for the runs (default: demo/minutes)")
    parser.add_argument("--only", nargs="+", help="scenes, all where none is named")
    parser.add_argument("--minutes", nargs="+", type=float, default=[2, 5, 10, 20])
    options = parser.parse_args(arguments)
    out = options.out or clone_root() / "demo" / "minutes"
    scenes = find_scenes(options.scenes, options.only)
    table, failed = Table(*HEADINGS, title="what a training makes of a given time"), []
    for scene in scenes:
        ways = {name: (["--preset", name], None) for name in PRESETS}
        ways |= {f"{minutes:g} minutes": ([], minutes) for minutes in options.minutes}
        done = {}
        for name, (words, minutes) in ways.items():
            run = out / name / scene.name
            if runs.measure(scene, run, words, minutes, scene / "ground_truth"):
                done[name] = run
            else:
                failed.append(run)
        presets = {name: run for name, run in done.items() if name in PRESETS}
        for name, run in done.items():
            ended, found = course(run)[-1], runs.figures(run)
            lines = history.read((run / history.FILE).read_text(encoding="utf-8"))
            before = best(presets, ended[0]) if name not in PRESETS else None
            beside = (
                ("", "", "") if before is None else (f"{before[0]:.2f}", before[1], f"{ended[1] - before[0]:+.2f} dB")
            )
            count = f"{lines[-1]['iteration']:,}", f"{found['splats']:,}"
            table.add_row(scene.name, name, f"{ended[0]:.0f} s", *count, f"{ended[1]:.2f}", *beside)
    console.print(table)
    runs.say_failed(failed)


if __name__ == "__main__":
    main()
