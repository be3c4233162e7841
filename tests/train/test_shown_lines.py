"""Test which lines of a training are shown, and that log.txt in its run folder has all of them."""

import pytest

from refgs import cli, train_job
from refgs.asked import Asked
from refgs.train.keep import snapshot
from tests.makers.kills import CHANGES
from tests.makers.training import trainer


def words(capture, run, *others):
    changes = [word for change in CHANGES for word in ("--set", change)]
    return ["train", str(capture), "--out", str(run), "--preset", "quick", "--device", "cpu", *changes, *others]


def printed(capsys, *words) -> list[str]:
    """Run a command of refgs in this process, and return the lines that it prints."""
    capsys.readouterr()
    cli.app(words, standalone_mode=False)
    return [line for line in capsys.readouterr().out.splitlines() if line.strip()]


def test_details_are_in_the_log_alone(ball_capture, tmp_path, capsys):
    run = tmp_path / "a run"
    lines = printed(capsys, *words(ball_capture, run))
    logged = (run / "log.txt").read_text(encoding="utf-8").splitlines()
    *shown, trained, following = lines
    assert trained.startswith("trained 30 iterations in ") and trained.endswith(f"held-out views: {run}")
    assert following == f"next, make its mesh and textures: refgs export '{run}'"
    assert [line for line in logged if line in shown] == shown
    for part in ("surfels start on the visual hull", "the light stands still: "):
        assert any(part in line for line in logged) and not any(part in line for line in shown), lines
    # Of parts that are left out, those that an artist can ask for are shown.
    left_out = {line.split(":")[0] for line in shown if line.startswith("without ")}
    assert left_out <= {"without specular shading", "without inter-reflection", "without duplicate photos"}, lines


def test_verbose_prints_the_log(ball_capture, tmp_path, capsys):
    run = tmp_path / "run"
    *lines, _, _ = printed(capsys, *words(ball_capture, run, "--verbose"))
    assert lines == (run / "log.txt").read_text(encoding="utf-8").splitlines()
    assert any("surfels start on the visual hull" in line for line in lines)


def test_the_log_of_a_resumed_training_goes_on(ball_capture, tmp_path):
    run, said = tmp_path / "run", []
    asked = Asked(ball_capture, run, "quick", "cpu", changes=tuple(CHANGES))

    def report(event, facts):
        if "what" in facts:
            said.append(facts["what"])

    train_job.train(asked, report, lambda state: state.iteration >= 16)
    train_job.train(asked.resumed(), report, lambda state: False)
    assert (run / "log.txt").read_text(encoding="utf-8").splitlines() == said
    assert said.count("resumed at iteration 16") == 1


def test_a_fault_is_added_to_the_log(ball_capture, tmp_path):
    run = tmp_path / "run"

    def fail(state):
        raise ZeroDivisionError("a fault of ours")

    with pytest.raises(ZeroDivisionError):
        train_job.train(Asked(ball_capture, run, "quick", "cpu", changes=tuple(CHANGES)), lambda *_: None, fail)
    log = (run / "log.txt").read_text(encoding="utf-8")
    assert log.index("surfels start on the visual hull") < log.index("Traceback")
    assert log.endswith("ZeroDivisionError: a fault of ours\n")


def test_what_replaces_a_shown_line_is_shown(ball_capture, tmp_path):
    """Announce details and lines that replace each other, also after a resume from a checkpoint."""
    heard = []

    def report(event, facts):
        if event == "decided" and facts["about"] in ("a", "b"):
            heard.append((facts["what"], facts["detail"]))

    state = trainer(ball_capture, tmp_path / "run", report=report).state
    state.announce("a", "matte", detail=True)
    state.announce("a", "matte", detail=True)
    state.announce("a", "still matte", detail=True)
    state.announce("b", "metal")
    assert heard == [("matte", True), ("still matte", True), ("metal", False)]
    snapshot.save(state)
    heard.clear()
    resumed = trainer(ball_capture, tmp_path / "run", report=report).state
    snapshot.restore(resumed, tmp_path / "run")
    assert heard == [("still matte", True), ("metal", False)]
    resumed.announce("b", "no metal after all", detail=True)
    resumed.announce("a", "glossy")
    resumed.announce("a", "matte", detail=True)
    assert heard[2:] == [("no metal after all", False), ("glossy", False), ("matte", False)]
