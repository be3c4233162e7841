"""Test how run.toml records the settings that the program changed.

For each it records the requested value, the value in effect, and the reason.
"""

import math
import tomllib

from refgs import train_job
from refgs.asked import Asked
from refgs.capture import read_capture
from refgs.effective import Change, Effective
from refgs.run import create_run, open_run, record_changes
from refgs.run_folder import read_run_facts
from refgs.settings import NeedsSettings, load_settings
from refgs.train.decide.needs import NEEDS
from refgs.train.fit import between
from tests.makers.training import SMALL


def changed(folder):
    """Read the table [changed] of run.toml."""
    return tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))["changed"]


def test_a_change_keeps_what_was_asked():
    asked = load_settings("quick")
    first = Effective.of(asked).changed("surfels.budget", 900, "memory", "the card is full")
    second = first.changed("surfels.budget", 700, "memory", "it is full again")
    assert second.asked is asked and second.settings.surfels.budget == 700 and first.settings.surfels.budget == 900
    assert second.changes == {"surfels.budget": Change(asked.surfels.budget, 700, "memory", "it is full again")}
    assert second.settings.model_copy(update={"surfels": asked.surfels}) == asked


def test_a_value_that_stays_is_no_change():
    asked = load_settings("quick")
    assert not Effective.of(asked).changed("light.frame", asked.light.frame, "photos", "").changes


def test_a_plan_changes_each_number_that_differs():
    quick, standard = load_settings("quick"), load_settings("standard")
    planned = Effective.of(quick).moved_to(between(quick, standard, 0.5), "plan", "5 minutes were given")
    before, after = quick.model_dump(mode="json"), planned.settings.model_dump(mode="json")
    differ = {f"{s}.{n}" for s, table in before.items() for n, value in table.items() if after[s][n] != value}
    assert differ == {*planned.changes} and {"surfels.budget", "train.iterations"} <= differ
    assert all(change.by == "plan" for change in planned.changes.values()) and not planned.chosen()


def test_a_run_says_what_changed_its_settings(ball_capture, tmp_path):
    """Check that run.toml records the settings that the training changed, and that a resumed run keeps these records.

    The training changes settings to suit the photos, or to leave out a part of the method that the scene does not need.
    """
    out, words = tmp_path / "run", (*SMALL, "train.iterations=40", "needs.specular=off")
    asked = Asked(ball_capture, out, "quick", "cpu", changes=words)
    train_job.train(asked, lambda *_: None, lambda state: state.iteration == 30)
    rows, settings = changed(out), read_run_facts(out)[1]
    assert rows["light.frame"]["asked"] == "auto" and rows["light.frame"]["by"] == "photos"
    assert rows["light.frame"]["became"] == settings.light.frame == "world"
    assert rows["render.reflection"]["asked"] == "microfacet" and rows["render.reflection"]["by"] == "needs"
    assert (rows["train.iterations"]["asked"], rows["train.iterations"]["became"]) == (40, 32)
    assert "environment.resolution" not in rows
    train_job.train(asked.resumed(), lambda *_: None, lambda _: False)
    ended = changed(out)
    assert {key: ended[key] for key in rows} == rows and read_run_facts(out)[1] == settings
    assert open_run(out).splats is not None


def test_a_run_without_the_table_opens(ball_capture, tmp_path):
    """Check that a run.toml without the table [changed], as earlier releases wrote it, can be read and stays unchanged."""
    settings = load_settings("quick")
    create_run(tmp_path / "run", read_capture(ball_capture), settings, "quick", "cpu")
    before = (tmp_path / "run" / "run.toml").read_bytes()
    record_changes(tmp_path / "run", {})
    assert (tmp_path / "run" / "run.toml").read_bytes() == before
    rows = {"surfels.budget": {"asked": 900, "became": 700, "by": "memory", "why": "full"}}
    record_changes(tmp_path / "run", rows)
    record_changes(tmp_path / "run", {"surfels.budget": rows["surfels.budget"] | {"asked": 700, "became": 500}})
    assert changed(tmp_path / "run")["surfels.budget"] == {"asked": 900, "became": 500, "by": "memory", "why": "full"}
    assert read_run_facts(tmp_path / "run")[1] == settings


def test_the_needs_are_those_of_the_settings():
    assert {need.name for need in NEEDS} == {*NeedsSettings.model_fields} and len(NEEDS) == 9
    assert all(need.what and need.moments for need in NEEDS)
    assert all(need.reason for need in NEEDS if not math.isnan(need.threshold))
