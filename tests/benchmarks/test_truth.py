"""The table where the truth is known: what is trained, for how long, and what is printed."""

import json
from pathlib import Path

from rich.console import Console

from benchmarks import runs, truth


def test_colour_by_direction_is_trained_as_long(tmp_path, monkeypatch):
    (tmp_path / "ball" / "ground_truth").mkdir(parents=True)
    called = []

    def call(command: str, folder: Path, *words: object) -> int:
        called.append((command, folder.name, *map(str, words)))
        if command == "train":
            run = Path(words[1])
            run.mkdir(parents=True)
            (run / "splats.ply").touch()
        else:
            found = {
                "split": "test",
                "psnr": 31.0 if "deferred" in str(folder) else 26.0,
                "training_seconds": 80.0,
                "total_seconds": 90.0,
            }
            (folder / "metrics.json").write_text(json.dumps(found))
        return 0

    monkeypatch.setattr(runs, "call", call)
    assert truth.measure(tmp_path / "ball", tmp_path / "out", "quick")
    first, _, second, evaluated = called
    assert "--minutes" not in first and second[-4:] == ("--set", "shading=sh", "--minutes", "1.5")
    assert evaluated[-2:] == ("--ground-truth", str(tmp_path / "ball" / "ground_truth"))
    row = truth.row(*(runs.figures(tmp_path / "out" / kind / "ball") for kind in ("deferred", "sh")))
    assert (row["psnr"], row["sh"], row["relit"], row["light"]) == (31.0, 26.0, None, None)


def test_the_mean_is_of_the_reflective_scenes():
    rows = {"ball": [30.0, None], "matte": [10.0, 1.0], "car": [32.0, 1.0]}
    console = Console(width=100)
    with console.capture() as capture:
        console.print(truth.table_of("title", ["a", "b"], rows, [".1f", ".2f"]))
    cells = [line.strip("│ ").split("│") for line in capture.get().splitlines() if "mean" in line]
    assert [cell.strip() for cell in cells[0]] == ["mean, reflective", "31.0", "–"]
