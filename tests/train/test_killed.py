"""Test trainings that stop at a given moment, or cannot write: resumed, they end with the same files as one that was left alone."""

import re
from itertools import pairwise

import pytest

from refgs import train_job
from refgs.asked import Asked
from refgs.errors import InputError, TryAgain
from tests.makers.kills import CHANGES, files


class Killed(BaseException):
    """Raised in place of a signal: nothing that runs may catch it."""


def check_same(run, whole):
    """Check that two runs have the same files, with the same contents apart from seconds, and as many lines of history."""
    got, expected = files(run), files(whole)
    assert got.keys() == expected.keys()
    assert [name for name in expected if got[name] != expected[name]] == []


def train(capture, run, attend=lambda state: False, resume=False):
    asked, said = Asked(capture, run, "quick", "cpu", changes=tuple(CHANGES)), []
    asked = asked.resumed() if resume else asked
    train_job.train(asked, lambda event, facts: said.append((event, facts.get("what", ""))), attend)
    return said


@pytest.fixture(scope="module")
def whole(ball_capture, tmp_path_factory):
    """Train without a disturbance, and return the run's folder."""
    run = tmp_path_factory.mktemp("whole") / "run"
    train(ball_capture, run)
    return run


@pytest.mark.parametrize("names", [("occluder.ply", "needs.json"), ("splats.ply",)])
def test_results_that_could_not_be_written_are_written_by_a_resume(ball_capture, whole, tmp_path, names):
    """Put folders, which files cannot replace, where results belong. Remove them in the order of writing, and resume each time."""
    run = tmp_path / "run"

    def block(state):
        if state.iteration == state.total - 1:
            for name in names:
                (run / name).unlink(missing_ok=True)
                (run / name).mkdir()
        return False

    with pytest.raises(TryAgain, match=rf"{re.escape(names[0])}.*directory"):
        train(ball_capture, run, block)
    for name, following in pairwise(names):
        (run / name).rmdir()
        with pytest.raises(TryAgain, match=rf"{re.escape(following)}.*directory"):
            train(ball_capture, run, resume=True)
    (run / names[-1]).rmdir()
    assert not (run / "splats.ply").exists()
    assert ("stage", "resumed at iteration 30") in train(ball_capture, run, resume=True)
    check_same(run, whole)


def kill_at(iteration):
    def kill(state):
        if state.iteration == iteration:
            raise Killed
        return False

    return kill


def test_killed_before_its_first_checkpoint_it_starts_over(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(5))
    assert ("stage", "there is no checkpoint to resume from: starting over") in train(ball_capture, run, resume=True)
    check_same(run, whole)


def test_killed_before_its_first_checkpoint_it_makes_room_for_a_new_training(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(5))
    train(ball_capture, run)
    check_same(run, whole)


def test_a_training_that_has_learned_something_makes_no_room(ball_capture, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(11))
    with pytest.raises(InputError, match="holds another run"):
        train(ball_capture, run)
    for file in (run / "checkpoints").glob("*.toml"):
        file.rename(file.with_name(file.name + ".damaged"))
    with pytest.raises(InputError, match="holds another run"):
        train(ball_capture, run)


def test_a_damaged_checkpoint_and_history_cost_a_line_each(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(20))
    (run / "checkpoints" / "00000016.toml").write_text("")
    with open(run / "history.jsonl", "ab") as file:
        file.write(b'\xff\n{"iteration": "ten"}\n{"iteration": 1')
    said = train(ball_capture, run, resume=True)
    warnings = [what for event, what in said if event == "warning"]
    assert len(warnings) == 2 and "iteration 16 is damaged and set aside" in warnings[0]
    assert warnings[1] == "history.jsonl has damaged lines, which are left out: 3"
    assert ("stage", "resumed at iteration 8") in said
    for file in (run / "checkpoints").glob("*.damaged"):
        file.unlink()
    check_same(run, whole)
