"""Test how the settings of a training are chosen when the user gives only its duration."""

import json
import tomllib
from itertools import pairwise

import pytest

from refgs import train_job
from refgs.asked import Asked
from refgs.capture import read_capture
from refgs.effective import Effective
from refgs.settings import load_settings
from refgs.train.decide.object_size import LEAST
from refgs.train.fit import FASTEST, REHEARSED, WARM, _scheduled, between, fitting
from refgs.train.plan import Plan

QUICK, STANDARD = load_settings("quick"), load_settings("standard")


def test_it_lies_between_the_presets():
    assert between(QUICK, STANDARD, 0.0) == QUICK and between(QUICK, STANDARD, 1.0) == STANDARD
    half = between(QUICK, STANDARD, 0.5)
    assert half.surfels.budget == pytest.approx((24000 * 160000) ** 0.5, abs=1)
    assert half.environment.resolution == 64 and half.image.max_side == 566
    assert half.loss == STANDARD.loss and half.rates == STANDARD.rates
    beyond = between(QUICK, STANDARD, 2.0)
    assert beyond.surfels.budget == 1_066_667 and beyond.environment.resolution == 256 and beyond.image.max_side == 1600


@pytest.mark.parametrize("part, factor", [(0.25, 2), (0.5, 2**0.5), (1.01, 1), (1.99, 1), (4, 0.5**0.5)])
def test_rates_change_only_beyond_the_presets(part, factor):
    """Check that `part` times the iterations of the preset `quick` gives `factor` times its learning rates.

    The preset `standard` has twice the iterations of `quick`. From `quick` to `standard`, the rates do not change. With fewer iterations
    than `quick`, they are higher. With more iterations than `standard`, they are lower.
    """
    assert STANDARD.train.iterations == 2 * QUICK.train.iterations
    rates = _scheduled(QUICK, part * QUICK.train.iterations, QUICK, STANDARD).rates
    assert rates.position == pytest.approx(factor * QUICK.rates.position)
    assert rates.decay == QUICK.rates.decay


def test_more_time_brings_more_of_all(ball_capture, tmp_path):
    """Check that a longer training has a finer mesh, more iterations and lower learning rates, and surfels as the object needs them.

    The durations range from less than the preset `quick` takes to more than `standard` takes. No training is run to its end.
    """
    capture = read_capture(ball_capture)
    said, found = [], []
    for minutes in (0.2, 6, 600):
        report = lambda event, facts: said.append(facts["what"])  # noqa: E731
        quick, standard = (load_settings(preset, ["surfels.hull=32"]) for preset in ("quick", "standard"))
        made = fitting(capture, Effective.of(quick), standard, tmp_path, Plan(minutes), "cpu", report)
        found.append(made.state.settings)
        assert made.state.total == made.state.settings.train.iterations and made.state.report is report
        if made.state.settings.mesh == QUICK.mesh:  # the rehearsal's iterations count as done
            assert WARM < made.state.iteration <= REHEARSED and made.state.seconds > 0
        else:
            assert made.state.iteration == 0 and made.state.seconds == 0
    short, *_, long = found
    assert short.train.iterations < QUICK.train.iterations
    assert short.densify.every < QUICK.densify.every and short.indirect.every < QUICK.indirect.every
    assert all(each.surfels.budget == LEAST for each in found), "the ball is small"
    assert long.mesh.triangles > QUICK.mesh.triangles
    assert long.train.iterations > 2 * STANDARD.train.iterations
    ratio = QUICK.train.iterations / short.train.iterations
    assert short.rates.albedo == pytest.approx(min(ratio**0.5, FASTEST) * QUICK.rates.albedo, rel=1e-3)
    assert short.rates.decay == QUICK.rates.decay
    ratio = long.train.iterations / STANDARD.train.iterations
    assert long.rates.position == pytest.approx(STANDARD.rates.position / ratio**0.5, rel=1e-3)
    for less, more in pairwise(found):
        assert less.rates.albedo >= more.rates.albedo
        assert less.mesh.triangles <= more.mesh.triangles and less.train.iterations < more.train.iterations
    assert sum("surfels start on" in line for line in said) == 3
    planned = [line for line in said if line.startswith("planned for")]
    assert [line.split(" minutes")[0] for line in planned] == [f"planned for {m}" for m in ("0.2", "6", "600")]


def test_a_training_with_nothing_but_a_time_is_planned(ball_capture, tmp_path):
    said = []
    report = lambda event, facts: said.append(facts.get("what", ""))  # noqa: E731
    out, few = tmp_path / "run", ("surfels.hull=32", "surfels.start=800", "surfels.budget=1000")
    made, _ = train_job.train(Asked(ball_capture, out, None, "cpu", 0.15, few), report, lambda _: False)
    assert made.ended and sum(line.startswith("planned for 0.15 minutes") for line in said) == 1
    facts = tomllib.loads((out / "run.toml").read_text(encoding="utf-8"))
    assert facts["run"]["preset"] == "0.15 minutes"
    assert json.loads((out / "metrics.json").read_text(encoding="utf-8"))["total_seconds"] > 0
