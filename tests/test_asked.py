"""Test the record of what a training was asked for."""

from pathlib import Path

import pytest

from refgs import asked, cli, commands
from refgs.asked import Asked
from refgs.errors import InputError
from refgs.settings import load_settings

HOW = Path("photos"), Path("run")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"device": "foo"}, "--device foo: take auto, cpu or cuda"),
        ({"minutes": float("nan")}, "--minutes nan: take a number of minutes"),
        ({"minutes": float("inf")}, "--minutes inf: take a number of minutes"),
        ({"run": Path("old")}, "--from and --hints go together"),
        ({"hints": Path("a.json")}, "--from and --hints go together"),
        ({"resume": True, "run": Path("old"), "hints": Path("a.json")}, "knows its hints: leave out"),
        ({"resume": True, "changes": ("train.seed=1",)}, "--set cannot change a run that is resumed"),
        ({"run": Path("old"), "hints": Path("a.json"), "preset": "quick"}, "it keeps its settings"),
        ({"run": Path("old"), "hints": Path("a.json"), "changes": ("train.seed=1",)}, "it keeps its settings"),
    ],
)
def test_wrong_arguments_are_named(words, says):
    with pytest.raises(InputError, match=says):
        Asked(*HOW, **words)


@pytest.mark.parametrize(
    "words",
    [
        {},
        {"preset": "quick", "device": "cpu", "changes": ("train.seed=1", "region.size=[1, 1, 2]")},
        {"minutes": 7.5, "resume": True},
        {"run": Path("old run"), "hints": Path("a.json")},
    ],
)
def test_the_command_line_of_a_training_asks_for_it(monkeypatch, words):
    heard = []
    monkeypatch.setattr(commands, "train", lambda *given: heard.append(given))
    cli.app(Asked(*HOW, **words).words(), standalone_mode=False)
    assert heard == [(Asked(*HOW, **words), False, False)]  # neither --once nor --verbose


def test_each_change_is_parsed_once(monkeypatch):
    changes, parsed = ("train.seed=3", "surfels.budget=900", "surfels.start=900"), []
    real = asked.parse_change
    monkeypatch.setattr(asked, "parse_change", lambda text: parsed.append(text) or real(text))
    planned = Asked(*HOW, minutes=5.0, changes=changes)
    for preset in ("standard", "quick"):
        assert planned.settings(preset) == load_settings(preset, changes)
    assert planned.settings() == load_settings("standard", changes)
    assert parsed == [*changes]


def test_what_a_resumed_training_is_asked_for():
    whole = Asked(*HOW, "quick", "cpu", 5.0, ("train.seed=3",))
    assert whole.resumed() == Asked(*HOW, "quick", "cpu", 5.0, resume=True)
    assert Asked(*HOW, minutes=5.0).preset_name == "5 minutes" and Asked(*HOW).preset_name == "standard"
    assert Asked(*HOW, minutes=5.0, run=Path("old"), hints=Path("a.json")).resumed() == Asked(
        *HOW, minutes=5.0, resume=True
    )
