"""The paper's tables with today's program: `refgs bench paper --data DIR`.

DIR holds the published data sets as they are downloaded, any part of them: `shiny_blender/SCENE`,
`glossy_synthetic/SCENE` (NeRO's, or converted to NeRF-Blender and then perhaps called SCENE_blender; its split
`synthetic_split_128.pkl` beside the scenes), `ref_real/SCENE` and `nerf_synthetic/SCENE`. Each scene that is there is trained on its
training views at the photos' own size and evaluated on its test views; the real ones with the reduced photos that are
usual (`images_4`, of the sedan `images_8`). Runs lie in OUT/PRESET/DATA SET/SCENE: one that is finished is not trained
again, one that was interrupted goes on. Prints Tables 1, 2 and 8 with the paper's own figures beside ours.
"""

import argparse
import tomllib
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from benchmarks import runs
from benchmarks.runs import console, figures, mean, text
from refgs.capture.nero import SPLIT
from refgs.errors import InputError
from refgs.paths import clone_root
from refgs.settings import load_settings

PAPER = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
NORMALS = PAPER.pop("normals")
MEASURES = (("psnr", "PSNR", ".2f"), ("ssim", "SSIM", ".3f"), ("lpips", "LPIPS", ".3f"))


@dataclass(frozen=True)
class Scene:
    """A scene of the paper that is on this disk: the data set's key, its name, and the folder to train on."""

    data_set: str
    name: str
    capture: Path

    def run(self, out: Path) -> Path:
        """Its run folder."""
        return out / self.data_set / self.name


def find_scenes(data: Path) -> list[Scene]:
    """The paper's scenes in a folder. Raises InputError, saying what to put where, if there are none."""
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


def measure(scene: Scene, run: Path, preset: str) -> bool:
    """Train and evaluate what of it is not done yet; whether that succeeded."""
    return runs.measure(scene.capture, run, ["--preset", preset, "--set", "image.max_side=8192"])


def tables(found: dict[tuple[str, str], dict[str, float]], preset: str) -> list[Table]:
    """The paper's tables from the figures of each (data set, scene)."""
    result = []
    for key, data_set in PAPER.items():
        rows = [(name, number) for number, name in enumerate(data_set["scenes"]) if (key, name) in found]
        if not rows:
            continue
        table = Table(
            "scene", title=f"{data_set['title']}: preset {preset}, {len(rows)} of {len(data_set['scenes'])} scenes"
        )
        columns = []
        for measure, heading, form in MEASURES:
            ours = [found[key, name].get(measure) for name, _ in rows]
            theirs = [data_set[measure][number] for _, number in rows]
            for title, values in ((heading, ours), ("paper", theirs)):
                table.add_column(title, justify="right")
                columns.append([text(value, form) for value in (*values, mean(values))])
        for name, *cells in zip([*(name for name, _ in rows), "mean"], *columns, strict=True):
            if name == "mean":
                table.add_section()
            table.add_row(name, *cells)
        result.append(table)
    shiny = {}
    for (key, name), row in found.items():
        if key == "shiny_blender":
            seconds = row.get("training_seconds")
            shiny[name] = row | {"hours": None if seconds is None else seconds / 3600}
    if shiny:
        title = (
            f"Table 2, Shiny Blender: preset {preset}, {len(shiny)} of {len(PAPER['shiny_blender']['scenes'])} scenes"
        )
        table = Table("scene", title=title)
        keys = (("normal_mae_degrees", "normal error, degrees", ".2f"), ("hours", "training, hours", ".2f"))
        for _, heading, _ in keys:
            table.add_column(heading, justify="right")
        for name, row in shiny.items():
            table.add_row(name, *(text(row.get(key), form) for key, _, form in keys))
        table.add_section()
        table.add_row("mean", *(text(mean([r.get(key) for r in shiny.values()]), form) for key, _, form in keys))
        table.add_row("paper", *(text(NORMALS[key], form) for key, _, form in keys))
        result.append(table)
    return result


def main(arguments: list[str] | None = None) -> None:
    """Measure what is there and print the tables; exit status 1 where a scene failed."""
    parser = argparse.ArgumentParser(prog="refgs bench paper", description="The paper's tables with today's program.")
    parser.add_argument("--data", type=Path, required=True, help="folder with shiny_blender/SCENE and so on")
    parser.add_argument("--out", type=Path, default=None, help="folder for the runs (default: demo/paper)")
    parser.add_argument("--preset", default="paper", help="a preset's name or a TOML file")
    options = parser.parse_args(arguments)
    load_settings(options.preset)  # one that is wrong is said before anything else
    preset = Path(options.preset).stem
    out = (options.out or clone_root() / "demo" / "paper") / preset
    scenes = find_scenes(options.data)
    failed = [scene for scene in scenes if not measure(scene, scene.run(out), options.preset)]
    found = {(scene.data_set, scene.name): figures(scene.run(out)) for scene in scenes if scene not in failed}
    for table in tables(found, preset):
        console.print(table)
    if failed:
        console.print(f"not measured, see above: {', '.join(f'{s.data_set}/{s.name}' for s in failed)}")
        raise SystemExit(1)


if __name__ == "__main__":
    main()
