"""Train on the data sets of the Ref-Gaussian paper, and compare with the paper's tables: `refgs bench paper --data DIR`.

The paper is "Reflective Gaussian Splatting" (Yao et al., ICLR 2025). RefGS implements its method.

DIR holds the published data sets as they are downloaded; some may be missing. The scenes' folders are `shiny_blender/SCENE`,
`ref_real/SCENE`, `nerf_synthetic/SCENE` and `glossy_synthetic/SCENE`. Glossy Synthetic may be in NeRO's format, with
`synthetic_split_128.pkl` beside the scenes, or in NeRF-Blender's format, where folders may be named SCENE_blender.

Each scene is trained on its training views at the photos' size, and evaluated on its test views. Real scenes use the usual reduced photos:
`images_8` for the sedan, `images_4` for the others. The run folders are OUT/PRESET/DATA SET/SCENE.
"""

import argparse
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.harness import Bench, Column, Table, console, figures, train
from refgs.capture.nero import SPLIT
from refgs.errors import InputError
from refgs.paths import clone_root
from refgs.settings import load_settings

PAPER = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
NORMALS = PAPER.pop("normals")
FORMS = {"psnr": ("PSNR", ".2f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f")}


class Scene(NamedTuple):
    """Describe a scene of the Ref-Gaussian paper that was found on this disk: its data set, its name, and the folder to train on."""

    data_set: str
    name: str
    capture: Path


def find_scenes(data: Path) -> list[Scene]:
    """Find the scenes of the Ref-Gaussian paper in a folder.

    Raise InputError if there are none. Its message names the folders where scenes are expected.
    """
    scenes = []
    for key, data_set in PAPER.items():
        for number, name in enumerate(data_set["scenes"]):
            folder = next((f for f in (data / key / name, data / key / f"{name}_blender") if f.is_dir()), None)
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
        places = ", ".join(f"{data / key / data_set['scenes'][0]}" for key, data_set in PAPER.items())
        raise InputError(f"{data}: none of the paper's scenes is here. Put them where these would be: {places}")
    return scenes


def tables() -> list[Table]:
    """Describe the tables to print: Tables 1, 8 and 2 of the Ref-Gaussian paper, with the measured values beside the paper's."""
    result = []
    for key, data_set in PAPER.items():
        columns = [
            Column(heading, figure, form, variant)
            for figure, (title, form) in FORMS.items()
            for heading, variant in ((title, key), ("paper", f"{key}, paper"))
        ]
        result.append(Table(data_set["title"], "paper", tuple(columns), mean=tuple(data_set["scenes"])))
    columns = Column("normals °", "normals", ".2f", "shiny_blender"), Column("hours", "hours", ".2f", "shiny_blender")
    mean = tuple(PAPER["shiny_blender"]["scenes"])
    title = "Table 2, Shiny Blender; the paper: {normal_mae_degrees} °, {hours} hours".format(**NORMALS)
    return [*result, Table(title, "paper", columns, mean=mean)]


def record(bench: Bench, scene: Scene, metrics: dict) -> None:
    """Add a scene's metrics, and the Ref-Gaussian paper's values, to the rows of `bench`. `metrics` is the run's metrics.json."""
    seconds = metrics.get("training_seconds")
    bench.record(scene.name, scene.data_set, "dB", psnr=metrics["psnr"])
    bench.record(scene.name, scene.data_set, "", ssim=metrics.get("ssim"), lpips=metrics.get("lpips"))
    bench.record(scene.name, scene.data_set, "°", normals=metrics.get("normal_mae_degrees"))
    bench.record(scene.name, scene.data_set, "h", hours=None if seconds is None else seconds / 3600)
    theirs = PAPER[scene.data_set]
    place = theirs["scenes"].index(scene.name)
    bench.record(scene.name, f"{scene.data_set}, paper", "", **{figure: theirs[figure][place] for figure in FORMS})


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on all scenes that are found, and print the tables. Exit with status 1 if a scene failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with shiny_blender/SCENE and so on")
    parser.add_argument("--out", type=Path, help="folder for the runs (default: demo/paper)")
    parser.add_argument("--preset", default="paper", help="a preset's name or a TOML file")
    bench = Bench("paper", parser, arguments)
    preset = bench.options.preset
    load_settings(preset)  # report a wrong preset before anything else
    out = (bench.options.out or clone_root() / "demo" / "paper") / Path(preset).stem
    for scene in find_scenes(bench.options.data):
        run = out / scene.data_set / scene.name
        if train(scene.capture, run, ("--preset", preset, "--set", "image.max_side=8192", "--set", "image.masks=off")):
            record(bench, scene, figures(run))
        else:
            bench.failed.append(run)
    bench.finish(*tables())
