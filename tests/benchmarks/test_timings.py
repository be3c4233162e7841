"""Test that the benchmarks of kernels and cards run; their figures depend on the machine."""

from argparse import ArgumentParser
from functools import partial

import pytest
import torch

from benchmarks import floors, gpu, kernels, machine
from benchmarks.harness import Bench

CPU = torch.device("cpu")


@pytest.fixture
def bench():
    return Bench("gpu", ArgumentParser(), [])


def test_the_cards_benchmark_runs(bench, capsys):
    """Run the card's benchmark on the CPU, except for its trainings."""
    gpu.measure_raster(bench, CPU, [(500, 60, 40)], rounds=2)
    gpu.measure_frames(bench, CPU, 500, 40, rounds=2)
    gpu.measure_iteration(bench, CPU, rounds=1)
    bench.finish(*gpu.TABLES)
    said = capsys.readouterr().out
    assert "500 surfels, 60×40" in said and "a frame, 500 surfels" in said and "an iteration" in said


def test_no_card_is_said(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as left:
        gpu.main([])
    assert left.value.code == 2 and "no NVIDIA card" in capsys.readouterr().out


def test_the_kernels_benchmark_runs(monkeypatch, bench):
    """Check that a small version of the kernels' benchmark records every step, on one instruction set."""
    for name, value in {"SPLATS": 300, "SIDE": 24, "ROUNDS": 1}.items():
        monkeypatch.setattr(kernels, name, value)
    monkeypatch.setattr(kernels.load, "supported", lambda: ["sse4"])
    monkeypatch.setattr(kernels, "ball", partial(kernels.ball, 300, 24))
    kernels.measure_all(bench)
    assert {row.scene for row in bench.rows} == set(kernels.STEPS.values())
    assert all(row.value > 0 for row in bench.rows)
    assert {row.figure for row in bench.rows} == {"least", "median", "floor"}


def test_covered_pairs_are_about_those_that_are_blended():
    """Check that the estimate of the pixels that surfels cover, summed over surfels, is within 15 % of the pixels that are blended.

    Surfels are so transparent that none is occluded, so the sum of alpha gives the number of blended pixels.
    """
    (positions, rotations, scales, _, _), camera = gpu.make_ball(2000, 200, 150, CPU)
    opacities = torch.full((2000,), 0.02)
    pairs = floors.covered_pairs([positions, rotations, scales, opacities, torch.zeros(2000, 1)], camera)
    raster = gpu.rasterize(positions, rotations, scales, opacities, torch.ones(2000, 1), camera, near=0.1)
    # Alpha falls from o to c across a covered ellipse; its mean is (o - c) / ln(o / c). Near and far side of the ball are both blended.
    mean = (0.02 - 1 / 255) / torch.log(torch.tensor(0.02 * 255))
    assert float(raster.features.sum() / mean) == pytest.approx(2 * pairs, rel=0.15)


def test_the_machine_has_some_speed():
    assert machine.arithmetic(0.05) > 1e9 and machine.bandwidth(0.05) > 1e8
