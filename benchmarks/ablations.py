"""What each part of the method is worth: `refgs bench ablations --scenes DIR`.

DIR holds captures with ground truth, as `python -m benchmarks.scenes all` makes them. The whole method is a preset with the paper's
stages (`WHOLE`); each ablation leaves out or replaces one part, by a setting. Each is trained for as many iterations as the whole,
and again for as long as the whole took on that scene. Runs lie in OUT/PRESET/iterations|time/NAME/SCENE: one that is finished is not
trained again, one that was interrupted goes on. Prints means over the scenes, how far they are from the whole's, and how far
the paper's Tables 3 and 4 are from its own.
"""

import argparse
from pathlib import Path

from rich.table import Table

from benchmarks import runs
from benchmarks.runs import console, figures, mean
from benchmarks.scenes import NAMES
from refgs.errors import InputError
from refgs.paths import clone_root
from refgs.settings import load_settings

# The shares of the training are the paper's: 18,000 of 58,000 iterations, and normals propagated every 2,000.
WHOLE = ("diffuse=sh", "initial.until=0.31", "needs.initial=on")
PROPAGATIONS = 29
REST = 300  # iterations between them at the least: in fewer, what has grown does not shrink again, and all becomes fog
ABLATIONS = {
    "the whole": (),
    "without 2DGS": ("primitive=3dgs",),
    "without PBR": ("reflection=mirror", "surfels.metallic=0.01"),  # or all of them are mirrors, which grow and grow
    "without inter-reflection": ("indirect.start=1",),
    "without deferred shading": ("shading=splat",),
    "without the initial stage": ("initial.until=0",),
    "without normal propagation": ("propagation.every=0",),
    "propagation without materials": ("propagation.metallic=0", "propagation.roughness=1"),
    "2DGS, colour by direction": ("shading=sh",),
    "3DGS, colour by direction": ("shading=sh", "primitive=3dgs"),
}
MEASURES = (
    ("psnr", "PSNR", ".2f"),
    ("ssim", "SSIM", ".4f"),
    ("flip", "FLIP", ".4f"),
    ("normal_mae_degrees", "normals °", ".2f"),
)
# PSNR on Glossy Synthetic (Table 4), and degrees of normals on Shiny Blender (Table 3).
PAPER = {
    "the whole": (30.33, 2.15),
    "without 2DGS": (None, 4.45),
    "without PBR": (29.84, 3.81),
    "without inter-reflection": (30.14, None),
    "without deferred shading": (28.85, None),
    "without the initial stage": (29.94, 3.53),
    "propagation without materials": (29.68, 3.86),
}


def find_scenes(folder: Path, only: list[str] | None = None) -> list[Path]:
    """The captures in a folder, or those of them that are named. Raises InputError where there are none."""
    found = [folder / name for name in NAMES if (folder / name / "ground_truth").is_dir()]
    if not found:
        raise InputError(f"{folder}: no scene is here: render them with python -m benchmarks.scenes all --out {folder}")
    chosen = [scene for scene in found if not only or scene.name in only]
    if not chosen:
        raise InputError(f"{folder} has none of {', '.join(only)}")
    return chosen


Found = dict[str, dict[str, dict[str, dict]]]
"""Figures by "iterations" or "time", ablation and scene."""


def measure(scenes: list[Path], out: Path, preset: str) -> tuple[Found, list[Path]]:
    """What was measured; and the run folders of what failed."""
    failed = []
    every = max(REST, load_settings(preset).train.iterations // PROPAGATIONS)
    found: Found = {"iterations": {}, "time": {}}
    for scene in scenes:
        for kind, rows in found.items():
            for name, changes in ABLATIONS.items():
                run = out / kind / name.replace(" ", "_").replace(",", "") / scene.name
                settings = [*WHOLE, f"propagation.every={every}", f"propagation.rest={max(1, every // 10)}", *changes]
                words = ["--preset", preset, *(word for change in settings for word in ("--set", change))]
                minutes = None
                if kind == "time":
                    whole = found["iterations"].get("the whole", {}).get(scene.name)
                    if name == "the whole" or whole is None:
                        continue
                    minutes = whole["total_seconds"] / 60
                if runs.measure(scene, run, words, minutes, scene / "ground_truth"):
                    rows.setdefault(name, {})[scene.name] = figures(run)
                else:
                    failed.append(run)
    return found, failed


def tables(found: Found) -> list[Table]:
    """A table for equal iterations and one for equal time: means over the scenes that all of it was measured on."""
    whole, result = found["iterations"].get("the whole", {}), []
    for kind, rows in found.items():
        rows = {"the whole": whole} | rows
        scenes = [name for name in whole if all(name in row for row in rows.values())]
        if not scenes:
            continue
        table = Table(
            kind, title=f"as many {kind}" if kind == "iterations" else "as much time", caption=", ".join(scenes)
        )
        for _, heading, _ in MEASURES:
            table.add_column(heading, justify="right")
        table.add_column("paper: PSNR, normals °", justify="right")
        means = {
            name: {key: mean([row[s].get(key) for s in scenes]) for key, *_ in MEASURES} for name, row in rows.items()
        }
        for name, values in means.items():
            cells = []
            for key, _, form in MEASURES:
                cells.append(_beside(values[key], means["the whole"][key], form, name))
            theirs = zip(PAPER.get(name, (None, None)), PAPER["the whole"], (".2f", ".2f"), strict=True)
            table.add_row(
                name, *cells, ", ".join(_beside(value, of_whole, form, name) for value, of_whole, form in theirs)
            )
        result.append(table)
    return result


def _beside(value: float | None, of_whole: float | None, form: str, name: str) -> str:
    """A figure, and how far it is from the whole method's."""
    if value is None:
        return "–"
    away = f" ({value - of_whole:+{form}})" if name != "the whole" and of_whole is not None else ""
    return f"{value:{form}}{away}"


def main(arguments: list[str] | None = None) -> None:
    """Train what is not trained yet, and print the tables."""
    parser = argparse.ArgumentParser(prog="refgs bench ablations", description="What each part of the method is worth.")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder for the runs (default: demo/ablations)")
    parser.add_argument("--preset", default="quick", help="a preset's name or a TOML file")
    options = parser.parse_args(arguments)
    out = (options.out or clone_root() / "demo" / "ablations") / Path(options.preset).stem
    found, failed = measure(find_scenes(options.scenes), out, options.preset)
    for table in tables(found):
        console.print(table)
    runs.say_failed(failed)


if __name__ == "__main__":
    main()
