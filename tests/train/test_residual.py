"""Test the residual: a colour that depends on direction and is added to the shaded picture."""

import json

import numpy as np
import pytest
import torch

from refgs.color import srgb_encode
from refgs.model import harmonics
from refgs.render.rasterize import rasterize
from refgs.render.volume import discs
from refgs.run import open_run
from refgs.train.keep.asset import write_asset
from tests.makers.training import asset_error, trained, trainer

CHANGES = ["train.light_first=0", "residual.start=0.5", "rates.residual=0.02"]
CHANGES += ["needs.specular=on", "needs.degrees=on"]  # there are too few iterations to decide these


@pytest.fixture(scope="module")
def learned(ball_capture, tmp_path_factory):
    return trained(ball_capture, tmp_path_factory.mktemp("runs") / "ball", *CHANGES, total=60)


def test_it_learns_when_material_and_light_have(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", *CHANGES, total=60)
    rest = made.state.learned["sh_rest"]
    for _ in range(30):
        made.step()
        assert made.state.surfels().sh_rest.shape[1] == 0 or made.state.iteration == 30
    assert not rest.any() and "sh_rest" not in made.state.learned.moments
    stays = [made.state.learned[name] for name in ("albedo", "metallic", "roughness")] + [
        made.state.learned["environment"]
    ]
    before = [value.detach().clone() for value in (*stays, made.state.learned["position"])]
    made.step()
    assert rest.any() and not torch.equal(made.state.learned["position"], before.pop())
    assert all(torch.equal(value, was) for value, was in zip(stays, before, strict=True))


def test_it_adds_its_blend_to_the_picture(learned):
    """Check that the surfels' residual colours are blended into a picture and added to the shaded picture.

    A surfel's residual is Σ_k c_k Y_k(d). c_k are its coefficients of spherical harmonics; d is the direction from camera to surfel.
    """
    run, camera = open_run(learned.state.folder), learned.state.test[0].camera
    surfels = run.surfels()
    ways = surfels.positions.double() - torch.from_numpy(camera.position)
    basis = harmonics.basis(torch.nn.functional.normalize(ways, dim=-1), 3)[:, 1:]
    added = (basis[:, :, None] * surfels.sh_rest.double()).sum(dim=1)
    blended = rasterize(*discs(surfels, camera), added.float().contiguous(), camera, near=run.near).features
    whole = run.render(camera)
    run.splats.sh = run.splats.sh[:, :1]
    without = run.render(camera)
    assert blended.abs().max() > 0.01
    torch.testing.assert_close(whole.color - without.color, blended, atol=2e-5, rtol=0)
    solid = whole.alpha > 0.9
    encoded = srgb_encode(without.radiance) + blended / whole.alpha[..., None]
    torch.testing.assert_close(srgb_encode(whole.radiance)[solid], encoded[solid].clamp_min(0), atol=1e-4, rtol=0)


def test_another_light_is_without_it(learned):
    run, camera = open_run(learned.state.folder), learned.state.test[0].camera
    light = run.light(np.ones((16, 32, 3), np.float32))
    with_it = run.render(camera, light).color
    run.splats.sh = run.splats.sh[:, :1]
    assert torch.equal(run.render(camera, light).color, with_it)


def test_a_run_shows_what_was_learned(learned):
    assert asset_error(learned) < 1e-3


def test_one_that_ends_before_it_leaves_none(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", *CHANGES, total=60)
    for _ in range(3):
        made.step()
    made.state.total = made.state.iteration  # end here
    write_asset(made.state)
    assert open_run(tmp_path / "run").splats.sh.shape[1] == 1


def test_without_it_no_harmonics_are_left(ball_capture, tmp_path):
    made = trained(ball_capture, tmp_path / "run", *CHANGES, "residual.start=1", total=10)
    assert "sh_rest" not in made.state.learned
    assert open_run(tmp_path / "run").splats.sh.shape[1] == 1
    left = json.loads((tmp_path / "run" / "needs.json").read_text(encoding="utf-8"))
    assert "spherical harmonics" in [one["what"] for one in left]
