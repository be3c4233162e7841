"""The table of ablations: its settings are valid, and what it prints is what was measured."""

import json
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import ablations, runs
from refgs.errors import InputError
from refgs.settings import load_settings


def finish(run: Path, **figures: float) -> None:
    """A run folder as it is after `refgs evaluate`."""
    run.mkdir(parents=True)
    (run / "splats.ply").touch()
    (run / "metrics.json").write_text(
        json.dumps({"split": "test", "training_seconds": 80.0, "total_seconds": 90.0, **figures})
    )


@pytest.mark.parametrize("name", ablations.ABLATIONS)
def test_settings_are_valid(name):
    whole = [*ablations.WHOLE, "propagation.every=100"]
    settings = load_settings("quick", [*whole, *ablations.ABLATIONS[name]])
    assert (settings == load_settings("quick", whole)) == (name == "the whole")
    assert set(ablations.PAPER) <= set(ablations.ABLATIONS)


def test_nothing_is_trained_twice_and_figures_stand_beside_the_wholes(tmp_path, monkeypatch):
    for scene in ("ball", "rings"):
        (tmp_path / scene / "ground_truth").mkdir(parents=True)
    with pytest.raises(InputError, match=r"benchmarks\.scenes all"):
        ablations.find_scenes(tmp_path / "ball")
    monkeypatch.setattr(ablations, "ABLATIONS", {"the whole": (), "without PBR": ("reflection=mirror",)})
    called = []

    def call(command: str, capture: Path, *words: object) -> int:
        called.append((command, capture.name, *map(str, words)))
        if command == "train":
            run = Path(words[1])
            psnr = 30 if "the_whole" in str(run) else 28
            finish(run, psnr=psnr + (run.name == "rings"), ssim=0.9, flip=0.1, normal_mae_degrees=3.0)
        return 0

    monkeypatch.setattr(runs, "call", call)
    found, failed = ablations.measure(ablations.find_scenes(tmp_path), tmp_path / "out", "quick")
    assert not failed
    assert [words[:2] for words in called if words[0] == "train"] == [("train", "ball")] * 3 + [("train", "rings")] * 3
    timed = [words for words in called if "--minutes" in words]
    assert len(timed) == 2 and all(words[-1] == "1.5" and "reflection=mirror" in words for words in timed)
    called.clear()
    assert ablations.measure(ablations.find_scenes(tmp_path), tmp_path / "out", "quick") == (found, []) and not called
    console = Console(width=200)
    with console.capture() as capture:
        for table in ablations.tables(found):
            console.print(table)
    rows = [line.split("│") for line in capture.get().splitlines() if "without PBR" in line]
    assert [row[2].strip() for row in rows] == ["28.50 (-2.00)"] * 2
    assert rows[0][6].strip() == "29.84 (-0.49), 3.81 (+1.66)"
