"""Test inter-reflection on two metal balls that mirror each other."""

import numpy as np
import pytest
import torch

from benchmarks.scenes.analytic import TWO, meet, write_ball_capture
from refgs.capture import read_capture
from refgs.compare.pictures import composite
from refgs.run import open_run
from refgs.train.keep.asset import write_asset
from refgs.train.keep.measures import held_out_psnr
from tests.makers import scenes
from tests.makers.training import trainer

CHANGES = ["surfels.start=3000", "surfels.budget=4000", "surfels.hull=144", "surfels.metallic=0.9"]
# Without a residual, which could learn part of the missing inter-reflection.
CHANGES += ["indirect.every=200", "indirect.resolution=64", "residual.start=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Train on the same capture with inter-reflection and without it. Return both trainers and two PSNRs.

    Both PSNRs are of the first training: just before and just after its inter-reflection starts.
    """
    folder = tmp_path_factory.mktemp("two")
    write_ball_capture(folder / "capture", 48, TWO)
    capture, made, heard = read_capture(folder / "capture"), [], []
    for start in (0.3, 1):
        run = trainer(capture, folder / str(start), *CHANGES, f"indirect.start={start}", total=400)
        if start < 1:
            run.run(stop=lambda run=run: run.state.iteration == 199)
            heard.append(held_out_psnr(run.state))
            run.step()
            assert run.state.occluder is not None
            heard.append(held_out_psnr(run.state))
        run.run()
        write_asset(run.state)
        made.append(run)
    return *made, heard


def test_pictures_gain_where_the_balls_mirror_each_other(trained):
    with_it, without, _ = trained
    assert held_out_psnr(with_it.state) > held_out_psnr(without.state)
    errors = [[], []]
    for view in with_it.state.test:
        hidden = with_it.state.render(view.camera).visibility < 0.5
        photo = composite(view, with_it.state.background)
        for run, error in zip((with_it, without), errors, strict=True):
            error.append((run.state.render(view.camera).color - photo)[hidden].square())
    one, other = (float(torch.cat(error).mean()) for error in errors)
    assert one < 0.8 * other


def test_joining_loses_nothing(trained):
    """Check that starting inter-reflection lowers the PSNR by less than 0.1 dB.

    The indirect light is first set to the environment's light, so the pictures hardly change.
    """
    before, after = trained[2]
    assert after > before - 0.1


def test_visibility_is_that_of_the_balls(trained):
    run = trained[0]
    counts = np.zeros(4)
    for view in run.state.test:
        rendering = run.state.render(view.camera)
        ray, hit, point, normal = scenes.meetings(view.camera, TWO)
        mirrored = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal
        meets, _, _ = meet(point, mirrored, TWO)
        sure = hit & (rendering.alpha.numpy().reshape(-1) > 0.9)
        traced = (rendering.visibility.numpy().reshape(-1) < 0.5) & sure
        counts += [(meets & sure).sum(), traced.sum(), (traced & meets).sum(), sure.sum()]
    hidden, found, both, solid = counts
    assert hidden > 0.02 * solid
    assert hidden + found - 2 * both < 0.03 * solid
    assert both > 0.6 * found


def test_the_run_folder_has_it_all(trained):
    """Check that the saved run renders like the trainer. Relighting it with its own environment must hardly change the pictures."""
    made = trained[0]
    run, view = open_run(made.state.folder), made.state.test[0]
    shown, asset = made.state.render(view.camera), run.render(view.camera)
    assert float((shown.color - asset.color).abs().mean()) < 2e-3
    assert run.splats.indirect.shape[1:] == (16, 3) and np.abs(run.splats.indirect).max() > 0
    relit = run.render(view.camera, run.environment)
    torch.testing.assert_close(relit.visibility, asset.visibility)
    free = asset.visibility > 0.5
    assert float((relit.color - asset.color)[free].abs().mean()) < 5e-3
    assert float((relit.color - asset.color)[~free].abs().mean()) < 0.1
    assert run.relit(run.environment) is run.relit(run.environment)
    assert open_run(trained[1].state.folder).occluder is None
