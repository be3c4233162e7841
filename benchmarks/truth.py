"""The whole method where the truth is known: `refgs bench truth --scenes DIR`.

DIR holds captures with ground truth, as `python -m benchmarks.scenes all` makes them. Each is trained by a preset and measured against
all that is known of it; then plain view-dependent colour (shading = sh) is trained for as long. Runs lie in
OUT/PRESET/deferred|sh/SCENE: one that is finished is not trained again, one that was interrupted goes on. Prints a table of what
was reached, and one of which part stands in the way (benchmarks.terms).
"""

import argparse
from pathlib import Path

from rich.table import Table

from benchmarks import runs
from benchmarks.ablations import find_scenes
from benchmarks.runs import console, figures, mean, text
from benchmarks.scenes import REFLECTIVE
from benchmarks.terms import PARTS, terms
from refgs.paths import clone_root
from refgs.settings import load_settings

COLUMNS = (
    ("PSNR", "psnr", ".2f"),
    ("sh", "sh", ".2f"),
    ("normals °", "normal_mae_degrees", ".2f"),
    ("base colour dB", "albedo", ".1f"),
    ("roughness", "roughness_mae", ".3f"),
    ("metallic", "metallic_mae", ".3f"),
    ("light log-RMSE", "light", ".2f"),
    ("relit dB", "relit", ".1f"),
    ("relit, aligned", "relit_aligned", ".1f"),
    ("seconds", "training_seconds", ".0f"),
)


def measure(scene: Path, out: Path, preset: str) -> bool:
    """Train and evaluate what of a scene is not done yet; whether that succeeded."""
    truth, deferred, words = scene / "ground_truth", out / "deferred" / scene.name, ["--preset", preset]
    if not runs.measure(scene, deferred, words, truth=truth):
        return False
    minutes = figures(deferred)["total_seconds"] / 60
    return runs.measure(scene, out / "sh" / scene.name, [*words, "--set", "shading=sh"], minutes, truth)


def row(found: dict, sh: dict) -> dict[str, float | None]:
    """One scene's figures, by the keys of `COLUMNS`."""
    relit = [light["refgs"] for light in found.get("relight", {}).values()]
    return found | {
        "sh": sh["psnr"],
        "albedo": found.get("albedo", {}).get("psnr_aligned"),
        "light": found.get("environment", {}).get("log_rmse"),
        "relit": mean([figure["psnr_raw"] for figure in relit]),
        "relit_aligned": mean([figure["psnr_aligned"] for figure in relit]),
    }


def table_of(title: str, headings: list[str], rows: dict[str, list[float | None]], forms: list[str]) -> Table:
    """A row a scene, and the mean of the reflective ones."""
    table = Table("scene", title=title)
    for heading in headings:
        table.add_column(heading, justify="right")
    reflective = [rows[name] for name in REFLECTIVE if name in rows]
    means = [mean(list(column)) for column in zip(*reflective, strict=True)]
    for name, values in [*rows.items(), *([("mean, reflective", means)] if reflective else [])]:
        table.add_row(name, *map(text, values, forms), end_section=name == list(rows)[-1])
    return table


def main(arguments: list[str] | None = None) -> None:
    """Measure what is there and print the tables; exit status 1 where a scene failed."""
    parser = argparse.ArgumentParser(prog="refgs bench truth", description="The whole method where the truth is known.")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder for the runs (default: demo/truth)")
    parser.add_argument("--preset", default="standard", help="a preset's name or a TOML file")
    options = parser.parse_args(arguments)
    load_settings(options.preset)  # one that is wrong is said before anything else
    out = (options.out or clone_root() / "demo" / "truth") / Path(options.preset).stem
    reached, in_the_way, failed = {}, {}, []
    for scene in find_scenes(options.scenes):
        if not measure(scene, out, options.preset):
            failed.append(scene.name)
            continue
        deferred = out / "deferred" / scene.name
        found = row(figures(deferred), figures(out / "sh" / scene.name))
        reached[scene.name] = [found.get(key) for _, key, _ in COLUMNS]
        in_the_way[scene.name] = list(terms(deferred, scene / "ground_truth").values())
    headings, _, forms = zip(*COLUMNS, strict=True)
    console.print(table_of(f"reached by {options.preset}", headings, reached, forms))
    headings = ["as it is", *(f"true {part}" for part in PARTS), "all true"]
    console.print(table_of("what stands in the way: PSNR on the object", headings, in_the_way, [".2f"] * len(headings)))
    if failed:
        console.print(f"not measured, see above: {', '.join(failed)}")
        raise SystemExit(1)


if __name__ == "__main__":
    main()
