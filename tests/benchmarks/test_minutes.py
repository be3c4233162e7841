"""Test finding the best PSNR that a preset had reached after so many seconds, with start and end of the run counted."""

import json

import pytest

from benchmarks.minutes import best, course


def test_the_best_by_then_is_of_the_whole_command(tmp_path):
    runs = {}
    for name, points in {
        "quick": [(10, 20.0), (100, 30.0)],
        "standard": [(10, 19.0), (150, 29.0), (400, 33.0)],
    }.items():
        runs[name] = tmp_path / name
        runs[name].mkdir()
        lines = [{"iteration": s, "seconds": s, "psnr_test": psnr} for s, psnr in points] + [
            {"iteration": 5, "seconds": 5}
        ]
        (runs[name] / "history.jsonl").write_text("\n".join(map(json.dumps, lines)))
        facts = {"training_seconds": points[-1][0], "total_seconds": points[-1][0] + 20}
        (runs[name] / "metrics.json").write_text(json.dumps(facts))
    assert course(runs["quick"]) == [(30, 20.0), (120, 30.0)]
    assert best(runs, 29) is None
    assert [best(runs, s) for s in (30, 119, 120, 500)] == [
        (20.0, "quick"),
        (20.0, "quick"),
        (30.0, "quick"),
        (33.0, "standard"),
    ]
    assert best(runs, 1e9)[0] == pytest.approx(33)
