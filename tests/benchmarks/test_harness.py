"""Test what all benchmarks share: training the missing runs, tables, the CSV of earlier values, and the page made from it."""

import json
from argparse import ArgumentParser
from pathlib import Path

import pytest

import benchmarks
from benchmarks import harness, needs, page, truth
from benchmarks.harness import Bench, Column, Row, Table
from refgs import commands
from refgs.errors import InputError
from refgs.settings import load_settings

WHERE = ("machine", "2026-01-01", "abc")


def row(scene: str, variant: str, figure: str, value) -> Row:
    return Row("truth", scene, variant, figure, value, "dB", *WHERE)


@pytest.fixture
def scenes(tmp_path):
    for scene in ("ball", "matte"):
        (tmp_path / "scenes" / scene / "ground_truth").mkdir(parents=True)
    return tmp_path / "scenes"


@pytest.fixture
def words(scenes, tmp_path):
    """Return the command-line options of a benchmark on the test's scenes."""
    return ["--scenes", str(scenes), "--out", str(tmp_path / "out"), "--csv", str(tmp_path / "a.csv")]


@pytest.fixture
def called(monkeypatch):
    """Replace `harness.call`, so that no command of refgs runs. The replacement only writes the files of a finished run.

    Return a list to which it appends the arguments of each call.
    """
    found = []

    def call(command: str, folder: Path, *words: object) -> int:
        found.append((command, folder.name, *map(str, words)))
        if command == "train":
            run = Path(words[1])
            run.mkdir(parents=True, exist_ok=True)
            (run / "splats.ply").touch()
            rows = [{"need": "specular", "needed": False}, {"need": "light", "needed": True}]
            (run / "needs.json").write_text(json.dumps(rows))
            (run / "history.jsonl").write_text('{"parts": {"deciding": 1.0}, "seconds": 50.0}\n')
        else:
            psnr = {"deferred": 31.0, "sh": 26.0}.get(folder.parent.name, 30.0)
            facts = {"split": "test", "psnr": psnr, "total_seconds": 90.0, "processor_seconds": 80.0}
            (folder / "metrics.json").write_text(json.dumps(facts))
        return 0

    monkeypatch.setattr(harness, "call", call)
    return found


def test_the_page_is_what_the_kept_figures_make():
    text = page.PAGE.read_text(encoding="utf-8")
    assert text == page.markdown(harness.read(harness.KEPT)), "run: refgs bench page"
    assert len(text.splitlines()) <= 110, "it should fit two screens"


def test_a_wrong_word_lists_the_benchmarks():
    with pytest.raises(
        InputError,
        match="no benchmark 'foo': take one of kernels, truth, real, cameras, paper, needs, poses, masks, minutes, look",
    ):
        commands.bench("foo", [])
    files = Path(benchmarks.__file__).parent.glob("*.py")
    assert set(benchmarks.BENCHMARKS) == {file.stem for file in files if "def main(arguments" in file.read_text()}


def test_nothing_is_trained_twice_and_colour_by_direction_as_long(scenes, words, called, tmp_path, capsys):
    words += ["--only", "ball"]
    truth.main(words)
    first, _, second, evaluated = called
    assert first[:2] == ("train", "ball") and "--minutes" not in first
    assert second[-4:] == ("--set", "shading=sh", "--minutes", "1.5")
    assert evaluated[-2:] == ("--ground-truth", str(scenes / "ball" / "ground_truth"))
    assert (tmp_path / "out" / "standard" / "sh" / "ball" / "metrics.json").exists()
    called.clear()
    truth.main(words)
    assert not called
    found = {r[1:4]: r.value for r in harness.read(tmp_path / "a.csv")}
    assert found["ball", "deferred", "psnr"] == 31 and found["ball", "sh", "psnr"] == 26
    assert ("ball", "deferred", "relit") not in found, "what was not measured is not written"


def test_an_interrupted_run_is_resumed(scenes, called, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.toml").touch()
    assert harness.train(scenes / "ball", run, ["--preset", "quick"])
    assert called[0][-1] == "--resume"
    (run / "metrics.json").write_text('{"split": "train", "psnr": 30.0}')
    called.clear()
    assert harness.train(scenes / "ball", run, []) and [words[0] for words in called] == ["evaluate"]


def test_what_fails_does_not_stop_the_others(words, monkeypatch, capsys):
    trained = []
    monkeypatch.setattr(harness, "call", lambda command, folder, *_: trained.append(folder.name) or 2)
    with pytest.raises(SystemExit) as left:
        truth.main(words)
    assert left.value.code == 1 and trained == ["ball", "matte"]
    assert "not measured, see above" in capsys.readouterr().out


def test_what_scenes_do_without(words, called, tmp_path, capsys):
    needs.main([*words, "--variants", "all on", "auto"])
    found = {r[1:4]: r.value for r in harness.read(tmp_path / "a.csv")}
    assert found["ball", "auto", "times_as_fast"] == 1 and found["ball", "auto", "left_out"] == "specular"
    assert found["ball", "auto", "deciding"] == 2


@pytest.mark.parametrize("variant", needs.CHANGES)
def test_variants_are_valid_settings(variant):
    changed = load_settings("quick", [*needs.CHANGES[variant]]) != load_settings("quick")
    assert changed == (variant != needs.AUTO)


def test_an_unknown_variant_is_said(words, called):
    with pytest.raises(InputError, match="no variant is called sideways: there are deferred, sh"):
        truth.main([*words, "--variants", "deferred", "sideways"])
    assert not called


def test_a_variant_needs_the_one_whose_time_limits_it(words, called):
    with pytest.raises(InputError, match="--variants: sh is trained for as long as deferred: add deferred"):
        truth.main([*words, "--variants", "sh"])
    assert not called
    truth.main([*words, "--variants", "sh", "deferred"])
    assert [call[-1] for call in called if call[0] == "train"] == ["standard", "1.5"] * 2


def test_no_scene_is_said(scenes):
    with pytest.raises(InputError, match=r"benchmarks\.scenes all"):
        harness.find_scenes(scenes / "ball")
    with pytest.raises(InputError, match="has none of moon"):
        harness.find_scenes(scenes, ["moon"])


def test_rows_become_a_table():
    columns = Column("a", "a", ".1f", "x"), Column("b", "b", ".2f", "x"), Column("c", "c")
    table = Table("", "truth", columns, mean=("one", "two"))
    rows = [row("one", "x", "a", 30.0), row("two", "x", "a", 32.0), row("two", "x", "b", 1.0)]
    rows += [row("matte", "x", "a", 10.0), row("other", "y", "a", 1.0)]
    kept = [row("one", "x", "a", 29.0)]
    assert table.lines(rows, kept) == [
        ["scene", "a", "b"],
        ["one", "30.0 (29.0)", "–"],
        ["two", "32.0", "1.00"],
        ["matte", "10.0", "–"],
        ["mean", "31.0", "–"],
    ]
    each = Table("", "truth", (Column("a", "a"),), variant="by")
    assert each.lines(rows)[1] == ["one", "x", "30.0"] and each.lines(rows)[-1] == ["other", "y", "1.0"]


def test_rows_are_replaced_not_repeated(tmp_path):
    file = tmp_path / "folder" / "a.csv"
    harness.write(file, [row("one", "x", "a", 1.0), row("one", "x", "b", "quick, standard")])
    harness.write(file, [row("one", "x", "a", 2.0)])
    assert [r.value for r in harness.read(file)] == [2.0, "quick, standard"]
    assert file.read_text().splitlines()[0].startswith("benchmark,scene,variant,figure,value,unit,machine,date,commit")


def test_where_a_figure_is_from(tmp_path):
    made = Bench("truth", ArgumentParser(), ["--csv", str(tmp_path / "a.csv")])
    made.record("ball", "", "dB", psnr=30.0, ssim=None)
    made.finish()
    (only,) = harness.read(tmp_path / "a.csv")
    assert only[:6] == ("truth", "ball", "", "psnr", 30.0, "dB") and all(only[6:])
