"""Train on published data sets, and compare with published figures: `refgs bench paper --data DIR`.

First among them are the tables of "Reflective Gaussian Splatting" (Yao et al., ICLR 2025), whose method RefGS implements. `paper.toml`
describes the data sets, what is measured on each, and what was published about it.

DIR holds the published data sets as they are downloaded; some may be missing. The scenes' folders are `shiny_blender/SCENE`,
`ref_real/SCENE`, `nerf_synthetic/SCENE`, `glossy_synthetic/SCENE`, `tensoir_synthetic/SCENE` and `stanford_orb/blender_HDR/SCENE`.

- Glossy Synthetic may be in NeRO's format, with `synthetic_split_128.pkl` beside the scenes, or in NeRF-Blender's format, where folders
  may be named SCENE_blender.
- TensoIR-Synthetic needs the folder `Environment_Maps` beside its scenes or in DIR.
- Stanford-ORB needs `stanford_orb/ground_truth`.

Each scene is trained on its training views at the photos' size, and evaluated on its test views. Real scenes use the usual reduced photos:
`images_8` for the sedan, `images_4` for the others, 512 pixels for Stanford-ORB. The run folders are OUT/PRESET/DATA SET/SCENE.
"""

import argparse
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.harness import Bench, Column, Table, console, figures, train
from refgs.capture.nero import SPLIT
from refgs.errors import InputError
from refgs.paths import clone_root
from refgs.report.figures import flatten
from refgs.settings import load_settings

PAPER = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
FIGURES = PAPER.pop("figures")


class Scene(NamedTuple):
    """Describe a scene that was found on this disk: its data set, its name, and the folder to train on."""

    data_set: str
    name: str
    capture: Path


def find_scenes(data: Path) -> list[Scene]:
    """Find the scenes of the published data sets in a folder.

    Raise InputError if there are none. Its message names the folders where scenes are expected.
    """
    scenes = []
    for key, data_set in PAPER.items():
        for number, name in enumerate(data_set["scenes"]):
            top = _folder(data, key)
            folder = next((f for f in (top / name, top / f"{name}_blender") if f.is_dir()), None)
            if folder is None:
                continue
            reduced = folder / data_set["photos"][number] if "photos" in data_set else folder
            if not reduced.is_dir():
                console.print(f"note: {reduced} is not there; {name} is measured on its photos of full size")
                reduced = folder
            scenes.append(Scene(key, name, reduced))
            if (folder / "0-camera.pkl").exists() and not any((f / SPLIT).exists() for f in (folder, folder.parent)):
                console.print(f"note: {SPLIT} is not in {folder.parent}; {name} is measured on every eighth view")
    if not scenes:
        places = ", ".join(f"{_folder(data, key) / data_set['scenes'][0]}" for key, data_set in PAPER.items())
        raise InputError(f"{data}: none of the published scenes is here. Put them where these would be: {places}")
    return scenes


def _folder(data: Path, key: str) -> Path:
    return data / PAPER[key].get("folder", key)


def tables() -> list[Table]:
    """Describe the tables to print, one for each data set, with the measured values beside the published ones."""
    result = []
    for key, data_set in PAPER.items():
        columns = [
            Column(heading, figure, FIGURES[figure][2], variant)
            for figure in data_set["shows"]
            for heading, variant in ((FIGURES[figure][0], key), ("published", f"{key}, published"))
        ]
        result.append(Table(data_set["title"], "paper", tuple(columns), mean=tuple(data_set["scenes"])))
    return result


def record(bench: Bench, scene: Scene, metrics: dict) -> None:
    """Add a scene's metrics, and the published values, to the rows of `bench`. `metrics` is the run's metrics.json."""
    known = dict(flatten(metrics))
    if "training_seconds" in known:
        known["training_hours"] = known["training_seconds"] / 3600
    theirs = PAPER[scene.data_set]
    place = theirs["scenes"].index(scene.name)
    for figure in theirs["shows"]:
        _, number, _, unit = FIGURES[figure]
        bench.record(scene.name, scene.data_set, unit, **{figure: known.get(number)})
        value = theirs[figure][place] if figure in theirs else math.nan
        bench.record(scene.name, f"{scene.data_set}, published", unit, **{figure: None if math.isnan(value) else value})


def record_others(bench: Bench, key: str) -> None:
    """Add the means that other methods reach on a data set to the rows of `bench`. Print where published values are from."""
    data_set = PAPER[key]
    others = data_set.get("others", {})
    for method, values in others.items():
        shown = [figure for figure in data_set["shows"] if figure in values]
        for figure in shown:
            bench.record(f"{method}: mean", f"{key}, published", FIGURES[figure][3], **{figure: values[figure]})
    published = [data_set["published"]] if "published" in data_set else []
    sources = "; ".join([*published, *(f"{method}: {values['source']}" for method, values in others.items())])
    console.print(f"{data_set['title']}: {data_set['protocol']}." + (f" Published: {sources}." if sources else ""))


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on all scenes that are found, and print the tables. Exit with status 1 if a scene failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with shiny_blender/SCENE and so on")
    parser.add_argument("--out", type=Path, help="folder for the runs (default: demo/paper)")
    parser.add_argument(
        "--preset", help="a preset's name or a TOML file (default: paper; standard for the data sets that are relit)"
    )
    bench = Bench("paper", parser, arguments)
    if bench.options.preset:
        load_settings(bench.options.preset)  # report a wrong preset before anything else
    measured = []
    for scene in find_scenes(bench.options.data):
        data_set = PAPER[scene.data_set]
        preset = bench.options.preset or data_set.get("preset", "paper")
        run = (bench.options.out or clone_root() / "demo" / "paper") / Path(preset).stem / scene.data_set / scene.name
        settings = f"image.max_side={data_set.get('side', 8192)}", "image.masks=off"
        if train(scene.capture, run, ("--preset", preset, "--set", settings[0], "--set", settings[1])):
            record(bench, scene, figures(run))
            measured.append(scene.data_set)
        else:
            bench.failed.append(run)
    for key in dict.fromkeys(measured):
        record_others(bench, key)
    bench.finish(*tables())
