"""Test that the benchmarks of CPU kernels and of GPUs run. How fast they run is not tested."""

from argparse import ArgumentParser
from functools import partial

import pytest
import torch

from benchmarks import floors, gpu, iteration, kernels, machine
from benchmarks.harness import Bench

CPU = torch.device("cpu")


@pytest.fixture
def bench():
    return Bench("gpu", ArgumentParser(), [])


def test_the_cards_benchmark_runs(bench, capsys, monkeypatch):
    """Run the GPU benchmark on the CPU, without its trainings, on a smaller scene."""
    monkeypatch.setattr(iteration, "SIZE", 32)
    monkeypatch.setattr(iteration, "SURFELS", 600)
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
    """Run the benchmark of CPU kernels on a small scene. Check that it records a time for every kernel."""
    for name, value in {"SPLATS": 300, "SIDE": 24, "ROUNDS": 1}.items():
        monkeypatch.setattr(kernels, name, value)
    monkeypatch.setattr(kernels.load, "supported", lambda: ["sse4"])
    monkeypatch.setattr(kernels, "ball", partial(kernels.ball, 300, 24))
    kernels.measure_all(bench)
    assert {row.scene for row in bench.rows} == set(kernels.STEPS.values())
    assert all(row.value > 0 for row in bench.rows)
    assert {row.figure for row in bench.rows} == {"least", "median", "floor"}


def test_covered_pairs_are_about_those_that_are_blended():
    """Check the estimate of how many pixels the surfels cover. It must agree to 15 % with what the rasteriser blends.

    Surfels are almost transparent, so that none hides another. The number of blended pixels is computed from the sum of alpha.
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
