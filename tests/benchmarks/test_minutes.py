"""Test how `best` finds the preset that has reached the best PSNR after a number of seconds.

The seconds are those since the command started, not only those of the iterations.
"""

import json

import pytest

from benchmarks.minutes import best, course


def test_the_best_by_then_is_of_the_whole_command(tmp_path):
    runs = {name: tmp_path / name for name in ("quick", "standard")}
    courses = [(10, 20.0), (100, 30.0)], [(10, 19.0), (150, 29.0), (400, 33.0)]
    for name, points in zip(runs, courses, strict=True):
        runs[name].mkdir()
        lines = [{"iteration": s, "seconds": s, "psnr_test": psnr} for s, psnr in points]
        lines.append({"iteration": 5, "seconds": 5})
        (runs[name] / "history.jsonl").write_text("\n".join(map(json.dumps, lines)))
        facts = {"training_seconds": points[-1][0], "total_seconds": points[-1][0] + 20}
        (runs[name] / "metrics.json").write_text(json.dumps(facts))
    assert course(runs["quick"]) == [(30, 20.0), (120, 30.0)]
    assert best(runs, 29) is None
    assert best(runs, 30) == best(runs, 119) == (20.0, "quick")
    assert best(runs, 120) == (30.0, "quick") and best(runs, 500) == (33.0, "standard")
    assert best(runs, 1e9)[0] == pytest.approx(33)
