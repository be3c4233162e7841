"""Test the report's curves of error over time: their Pareto front, their knee, and the time until a given error is reached.

After a curve's knee, more training improves little.

Test also the names that the report gives to runs.
"""

import numpy as np
import pytest

from refgs.formats.run_toml import Summary
from refgs.report.curves import QUANTITIES, Curve, curve, front, knee, levels, time_to
from refgs.report.labels import labels

PSNR, FLIP = QUANTITIES[:2]


def of(seconds, errors, run="a", quantity=FLIP):
    seconds = np.asarray(seconds, float)
    return Curve(run, quantity, np.arange(len(seconds)), seconds, np.asarray(errors, float))


def test_a_decibel_is_the_same_step_of_the_error_everywhere():
    lines = [{"seconds": 2.0, "iteration": 1, "psnr_test": 20.0}, {"seconds": 1.0, "iteration": 0, "psnr_test": 40.0}]
    lines += [
        {"seconds": 0, "psnr_test": 1.0},
        {"seconds": 3.0, "psnr_test": float("nan")},
        {"seconds": 3.0, "loss": 1},
    ]
    found = curve("a", lines, PSNR)
    np.testing.assert_allclose(found.errors, [0.01, 0.1])
    assert found.seconds.tolist() == [1, 2] and found.iterations.tolist() == [0, 1]
    assert PSNR.text(0.1) == "20 dB" and FLIP.text(0.125) == "0.125"
    assert not len(curve("a", [], PSNR).seconds)


def test_the_front_is_what_nothing_beats():
    """Check that the Pareto front holds exactly the points that no other point beats in both seconds and error."""
    random = np.random.default_rng(0)
    times = [np.sort(random.integers(1, 30, 25)) for _ in range(3)]
    curves = [of(t, (100 / t + random.exponential(20, 25)).round()) for t in times]
    points = np.array([point for c in curves for point in zip(c.seconds, c.errors, strict=True)])
    beaten = np.array([any((other <= point).all() and (other < point).any() for other in points) for point in points])
    on = np.concatenate(front(curves))
    assert 5 < on.sum() < 30 and not (on & beaten).any()
    assert {tuple(point) for point in points[on]} == {tuple(point) for point in points[~beaten]}
    assert [len(part) for part in front(curves)] == [25, 25, 25]


def test_the_knee_is_where_the_curve_bends():
    seconds = np.geomspace(1, 1000, 31)
    bent = np.where(seconds < 31, seconds**-1.0, 31**-0.9 * seconds**-0.1)
    at = knee(of(seconds, bent))
    assert seconds[at] == pytest.approx(31, rel=0.15)
    assert knee(of(seconds, seconds**-0.5)) is None, "a power law is straight"
    assert knee(of(seconds, 2 - seconds / 1000)) is None, "it falls ever faster"
    assert knee(of(seconds[:4], bent[:4])) is None and knee(of(seconds, np.ones(31))) is None
    noisy = np.where(np.arange(31) == 20, 5, bent)
    assert knee(of(seconds, noisy)) == at, "the best so far counts"


def test_the_time_to_an_error_is_a_power_laws_own():
    found = of([1, 3, 10, 40], np.array([1, 3, 10, 40.0]) ** -0.5)
    for error in (1.0, 0.7, 0.3, 0.2):
        assert time_to(found, error) == pytest.approx(error**-2)
    assert time_to(found, 0.1) is None and time_to(found, 2.0) == 1


def test_the_errors_of_the_table_are_round_and_passed():
    found = [of([1, 10], [0.31, 0.052]), of([1, 10], [0.2, 0.11])]
    assert levels(found) == pytest.approx([0.3, 0.25, 0.2, 0.15, 0.1])
    assert levels([of([1], [0.3])]) == []
    decibels = levels([of([1, 10], [10 ** (-20.7 / 20), 10 ** (-29 / 20)], quantity=PSNR)])
    assert (-20 * np.log10(decibels)).tolist() == pytest.approx([22, 24, 26, 28])


def facts(preset="quick", device="cpu", capture="/a/car", **settings):
    tables = {"image": {"max_side": 400}, "surfels": {"budget": 24000}, "rates": {"decay": 0.1}}
    for name, value in settings.items():
        section, key = name.split("__")
        tables[section] = tables[section] | {key: value}
    return Summary(run={"preset": preset, "device": device, "capture": capture}, settings=tables)


def test_runs_are_called_by_what_differs():
    names = ["r/1", "r/2", "r/3"]
    budgets = [facts(surfels__budget=n) for n in (1000, 24000, 50000)]
    assert labels(names, budgets) == ["1,000 surfels", "24,000 surfels", "50,000 surfels"]
    presets = [facts(), facts("standard", surfels__budget=60000, image__max_side=800), facts(device="H200")]
    assert labels(names, presets) == ["quick, cpu", "standard, cpu", "quick, H200"]
    others = [facts(), facts(rates__decay=0.2), facts(capture="C:\\b\\fox\\")]
    assert labels(names, others) == ["car, decay=0.1", "car, decay=0.2", "fox, decay=0.1"]


def test_runs_that_are_alike_are_called_by_their_folders():
    assert labels(["r/1", "r/2", "r/3"], [facts(), facts(), facts()]) == ["r/1", "r/2", "r/3"]
    found = labels(["r/1", "r/2", "r/3"], [facts(), facts(), facts(device="H200")])
    assert found == ["cpu (r/1)", "cpu (r/2)", "H200"]
    assert labels(["r/1", "r/2"], [Summary(), facts()])[0] == "r/1"
