"""Run every case of `refgs stability`, and the command itself. Cases that train are marked as slow."""

import subprocess
import sys

import pytest

from benchmarks.stability import geometry, material, optimisation, photos, stiffness
from benchmarks.stability.cases import Case, Outcome

QUICK = [*geometry.CASES, *material.CASES, stiffness.CASES[0]]
SLOW = [*photos.CASES, *optimisation.CASES, *stiffness.CASES[1:]]


@pytest.mark.parametrize(
    "case", [*QUICK, *(pytest.param(c, marks=pytest.mark.slow) for c in SLOW)], ids=lambda c: c.name
)
def test_case(case):
    found = case.run()
    assert case.holds(found), found


def test_a_case_can_fail():
    case = Case("", lambda: Outcome(True, 0.0), "", 1e-3, "", "")
    assert (
        case.holds(Outcome(True, 1e-3)) and not case.holds(Outcome(True, 2e-3)) and not case.holds(Outcome(False, 0.0))
    )
    assert not case.holds(Outcome(True, float("nan")))


def test_the_command():
    command = [sys.executable, "-m", "refgs.cli", "stability", "--only", "depth ties"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "depth ties" in done.stdout and "Adam" not in done.stdout
