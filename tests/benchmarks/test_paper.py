"""Test the benchmark on the Ref-Gaussian paper's data sets: which scenes it finds, which runs it skips, and the tables that it prints."""

import json
from pathlib import Path

import pytest

from benchmarks import harness, paper
from refgs import commands
from refgs.errors import InputError
from tests.makers.captures import colmap, nero, shiny_blender


def finish(run: Path, **figures: float) -> None:
    """Write the files of a run that is trained and evaluated. `figures` are its metrics."""
    run.mkdir(parents=True)
    (run / "run.toml").touch()
    (run / "splats.ply").touch()
    (run / "metrics.json").write_text(json.dumps({"split": "test", **figures}))


def test_the_papers_figures_are_its_means():
    """Check the numbers that were copied from the Ref-Gaussian paper.

    For two data sets, compare the means over the scenes with the means that the paper prints. They must be the same; only the PSNR of
    Glossy Synthetic, 30.33, differs slightly. For the other two data sets, check only that the means are plausible.
    """

    def mean(data_set: str, measure: str) -> float:
        values = paper.PAPER[data_set][measure]
        assert len(values) == len(paper.PAPER[data_set]["scenes"])
        return sum(values) / len(values)

    assert mean("shiny_blender", "psnr") == pytest.approx(35.04, abs=0.006)
    assert mean("shiny_blender", "ssim") == pytest.approx(0.973, abs=0.0006)
    assert mean("shiny_blender", "lpips") == pytest.approx(0.056, abs=0.0006)
    assert mean("glossy_synthetic", "psnr") == pytest.approx(30.33, abs=0.05)
    assert mean("glossy_synthetic", "ssim") == pytest.approx(0.958, abs=0.0006)
    assert mean("glossy_synthetic", "lpips") == pytest.approx(0.049, abs=0.0006)
    for data_set in ("ref_real", "nerf_synthetic"):
        assert 20 < mean(data_set, "psnr") < 40 and mean(data_set, "lpips") < mean(data_set, "ssim") < 1


def test_scenes_are_found_where_they_are_put(tmp_path, capsys):
    given = ["shiny_blender/ball", "shiny_blender/unknown", "glossy_synthetic/bell_blender", "nerf_synthetic/lego"]
    for scene in given:
        (tmp_path / scene).mkdir(parents=True)
    nero(tmp_path / "glossy_synthetic" / "cat", count=1)
    colmap(tmp_path / "ref_real" / "sedan", count=1)
    colmap(tmp_path / "ref_real" / "toycar", count=1)
    (tmp_path / "ref_real" / "toycar" / "images_4").mkdir()
    scenes = paper.find_scenes(tmp_path)
    assert [scene.capture.relative_to(tmp_path).as_posix() for scene in scenes] == [
        "shiny_blender/ball",
        "glossy_synthetic/bell_blender",
        "glossy_synthetic/cat",
        "ref_real/sedan",
        "ref_real/toycar/images_4",
        "nerf_synthetic/lego",
    ]
    said = capsys.readouterr().out
    assert "sedan is measured on its photos of full size" in said and "cat is measured on every eighth view" in said
    assert "toycar" not in said and "bell" not in said


def test_nothing_there_is_said_in_one_line(tmp_path):
    with pytest.raises(InputError) as error:
        commands.bench("paper", ["--data", str(tmp_path), "--preset", "standard"])
    message = str(error.value)
    assert "\n" not in message
    for place in ("shiny_blender/ball", "glossy_synthetic/angel", "ref_real/gardenspheres", "nerf_synthetic/chair"):
        assert str(tmp_path / place) in message


def test_tables_of_finished_runs(tmp_path, capsys):
    """Check that finished runs are not trained again, and that their tables are right.

    One scene has no LPIPS: its cell and the column's mean are empty.
    """
    data, out = tmp_path / "data", tmp_path / "runs"
    figures = "psnr", "ssim", "lpips", "normal_mae_degrees", "training_seconds"
    measured = {
        "shiny_blender/coffee": (36.0, 0.98, 0.1, 1.5, 1800),
        "shiny_blender/toaster": (32.0, 0.96, 0.03, 2.5, 1800),
        "glossy_synthetic/cat": (33.5, 0.97, 0.04),
        "nerf_synthetic/materials": (34.0, 0.97, 0.02),
        "nerf_synthetic/ship": (30.0, 0.9),
    }
    for name, values in measured.items():
        (data / name).mkdir(parents=True)
        finish(out / "standard" / name, **dict(zip(figures, values, strict=False)))
    paper.main(["--data", str(data), "--out", str(out), "--preset", "standard"])
    said = capsys.readouterr().out
    for number, data_set in (
        (1, "Shiny Blender"),
        (1, "Glossy Synthetic"),
        (8, "NeRF-Synthetic"),
        (2, "Shiny Blender"),
    ):
        assert f"Table {number}, {data_set}" in " ".join(said.split())
    rows = [line.replace("│", " ").split() for line in said.splitlines()]
    assert ["coffee", "36.00", "34.63", "0.980", "0.976", "0.100", "0.076"] in rows
    assert ["mean", "34.00", "31.34", "0.970", "0.962", "0.065", "0.075"] in rows
    assert ["cat", "33.50", "33.01", "0.970", "0.973", "0.040", "0.040"] in rows
    assert ["ship", "30.00", "30.78", "0.900", "0.898", "–", "0.125"] in rows
    assert ["mean", "32.00", "30.61", "0.935", "0.931", "–", "0.081"] in rows
    assert ["toaster", "2.50", "0.50"] in rows and ["mean", "2.00", "0.50"] in rows
    assert "the paper: 2.15 °, 0.58 hours" in said and "Ref-Real" not in said


def test_a_scene_that_fails_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    for name in ("ball", "car"):
        (tmp_path / "shiny_blender" / name).mkdir(parents=True)
    finish(tmp_path / "runs" / "standard" / "shiny_blender" / "car", psnr=31.0, ssim=0.9, lpips=0.1)
    monkeypatch.setattr(harness, "call", lambda *_: 2)
    with pytest.raises(SystemExit) as left:
        paper.main(["--data", str(tmp_path), "--out", str(tmp_path / "runs"), "--preset", "standard"])
    said = capsys.readouterr().out
    assert left.value.code == 1 and "31.00" in said
    assert "shiny_blender/ball" in said.partition("not measured, see above")[2]


def test_from_photos_to_the_tables(tmp_path, monkeypatch, capsys):
    """Train and evaluate a tiny version of Shiny Blender's ball, and print the tables."""
    shiny_blender(tmp_path / "shiny_blender" / "ball")
    preset = tmp_path / "tiny.toml"
    preset.write_text(
        'base = "quick"\n[surfels]\nstart = 300\nbudget = 300\nhull = 32\n[environment]\nresolution = 16\n'
        "[train]\niterations = 3\nlight_first = 1\n[indirect]\nstart = 1\n"
    )

    def call(what, folder, *options):
        if what == "train":
            assert options[0] == "--out" and options[2:4] == ("--preset", str(preset))
            commands.train(folder, options[1], str(preset), "cpu", None, [options[5]], False)
        else:
            commands.evaluate(folder, "test", None)
        return 0

    monkeypatch.setattr(harness, "call", call)
    paper.main(["--data", str(tmp_path), "--out", str(tmp_path / "runs"), "--preset", str(preset)])
    assert "Table 1, Shiny Blender" in capsys.readouterr().out
    assert (tmp_path / "runs/tiny/shiny_blender/ball/pictures/test/photo/r_0.png").exists()
