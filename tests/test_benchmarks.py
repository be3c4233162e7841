"""That the benchmarks run: what they print is a matter of the machine."""

import pytest
import torch

from benchmarks import floors, gpu, machine

CPU = torch.device("cpu")


def test_the_cards_benchmark_runs(capsys):
    """All but the trainings, with the CPU for a card."""
    gpu.raster_table(CPU, [(500, 60, 40)], rounds=2)
    gpu.frame_table(CPU, 500, 40, rounds=2)
    said = capsys.readouterr().out
    assert "500" in said and "frames a second" in " ".join(said.split())


def test_no_card_is_said(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as left:
        gpu.main()
    assert left.value.code == 2 and "no NVIDIA card" in capsys.readouterr().out


def test_covered_pairs_are_about_those_that_are_blended():
    """A ball of faint surfels hides nothing: its pixels' alphas add up to what the areas say."""
    (positions, rotations, scales, _, _), camera = gpu.make_ball(2000, 200, 150, CPU)
    opacities = torch.full((2000,), 0.02)
    pairs = floors.covered_pairs([positions, rotations, scales, opacities, torch.zeros(2000, 1)], camera)
    raster = gpu.rasterize(positions, rotations, scales, opacities, torch.ones(2000, 1), camera, near=0.1)
    # The mean alpha over a covered ellipse, where alpha falls from o to c: (o - c) / ln(o / c). Both halves of the ball count.
    mean = (0.02 - 1 / 255) / torch.log(torch.tensor(0.02 * 255))
    assert float(raster.features.sum() / mean) == pytest.approx(2 * pairs, rel=0.15)


def test_the_machine_has_some_speed():
    assert machine.arithmetic(0.05) > 1e9 and machine.bandwidth(0.05) > 1e8
