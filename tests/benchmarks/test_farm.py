"""Test the simulation of a farm: against measured batches, and against bounds that hold for any order of the steps."""

import random

import pytest

from benchmarks.farm import CROWDED, HEAD, SMALL, STANDARD, START, Farm, make_chains, simulate

HOUR = 3600.0


@pytest.mark.parametrize(("workers", "measured"), [(1, 379.5), (2, 211.2)])
def test_measured_batches_are_met(workers, measured):
    assert simulate(Farm(1, workers), SMALL, 24).seconds == pytest.approx(measured, rel=0.03)


@pytest.mark.parametrize("slow", [0, 100])
@pytest.mark.parametrize("places", [1, 4])
def test_without_storage_and_deaths_it_is_within_the_bounds_of_scheduling(places, slow):
    """Check Graham's bound: a queue never takes longer than the work of each place and the longest chain of steps together."""
    found = simulate(Farm(20, places, slow=slow), STANDARD, 300)
    chains = make_chains(STANDARD, 300, slow, random.Random(0))
    longest = max(sum(step.seconds for step in chain) for chain in chains)
    work = sum(step.seconds for chain in chains for step in chain) / 20 / places
    crowded = CROWDED if places > 1 else 1
    assert found.bound <= found.seconds <= START + crowded * (work + longest) + 1200 * HEAD
    assert found.bound >= START + work


def test_a_slow_storage_bounds_the_time():
    bytes_each = 6 * 64e6 + 34e6 + 34e6 + 34e6 + 71e6 + 1e6 + 3 * 3.7e6
    found = simulate(Farm(50, 16, storage=1e8), STANDARD, 400)
    assert found.storage > 0.9
    assert found.storage * found.seconds == pytest.approx(400 * bytes_each / 1e8, rel=0.001)


def test_deaths_cost_work_and_lose_no_step():
    whole, dying = (simulate(Farm(10, 2, dies=dies), STANDARD, 200) for dies in (0, HOUR))
    deaths = 10 * whole.seconds / (HOUR + 600)
    assert whole.twice == 0 and dying.seconds > whole.seconds
    lost = deaths * 2 * 80 / 2  # two steps each, half of the 80 seconds between checkpoints
    work = 200 * (482 + 44)
    assert dying.twice == pytest.approx(lost / work, rel=0.5)
