"""Test the guard, which rejects steps of the optimiser that contain NaN or infinity."""

import math

import numpy as np
import pytest
import torch

from benchmarks.stability.optimisation import nan_gradient, nan_value, resumed
from benchmarks.stability.training import ball, changed, trainer
from refgs.capture import read_capture
from refgs.errors import InputError
from refgs.model.environment import Environment
from refgs.model.learned import Learned
from refgs.render.baselines import LINEAR, SCREEN
from refgs.render.directional import directional
from refgs.render.rasterize import rasterize
from refgs.render.screen_gradient import ScreenGradient
from refgs.render.shade import shade
from refgs.settings import load_settings
from refgs.train.keep.progress import running
from refgs.train.learn.densify import Densification
from refgs.train.learn.guard import MOST_IN_A_ROW, Guard, remove_broken
from refgs.train.timeline import faint
from tests.makers import scenes


def learner(device):
    learned = Learned()
    for name, value in (("a", torch.randn(50, 3, device=device)), ("b", torch.randn(20, device=device))):
        learned.learn(name, value)
        learned.rates[name] = 0.1
    return [*learned.values()], learned


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e30])
def test_a_step_that_is_not_finite_leaves_all_as_it_was(device, wrong):
    """Check that a rejected step of the optimiser changes neither the values nor Adam's moments, bit for bit.

    A gradient of 1e30 is rejected too, because its square overflows float32.
    """
    values, learned = learner(device)
    guard, motion = Guard(torch.device(device)), ScreenGradient(50, torch.device(device))
    for step in range(3):
        before = [v.detach().clone() for v in values]
        moments = {name: (kept.mean.clone(), kept.square.clone()) for name, kept in learned.moments.items()}
        loss = sum((v**2).sum() for v in values)
        loss.backward()
        if step == 1:
            values[0].grad[7, 1] = wrong
        accepted = guard.judge(loss, learned)
        motion.add(values[0].detach(), values[0].grad, scenes.camera(), accepted)
        learned.step(accepted)
        assert float(accepted) == (step != 1)
        same = all(torch.equal(a, b) for a, b in zip(values, before, strict=True))
        assert same == (step == 1)
        if step == 1:
            assert moments.keys() == {"a", "b"}
            for name, (mean, square) in moments.items():
                kept = learned.moments[name]
                assert torch.equal(kept.mean, mean) and torch.equal(kept.square, square)
        learned.forget_gradients()
    assert motion.total.isfinite().all() and float(motion.views.max()) <= 2


def test_a_loss_that_is_no_number_is_not_stepped_on():
    values, learned = learner("cpu")
    sum((v**2).sum() for v in values).backward()
    assert float(Guard(torch.device("cpu")).judge(torch.tensor(math.nan), learned)) == 0


def test_no_kernel_hides_what_is_no_number(device):
    """Check that NaN in the input gives NaN in colours of spherical harmonics, in shading, and in the rasteriser's derivatives."""
    camera, nan = scenes.camera(20, 16), math.nan
    constant, rest, position = torch.ones(3, 1, 3), torch.ones(3, 3, 3), torch.rand(3, 3)
    constant[1, 0, 2] = rest[2, 1, 0] = nan
    color = directional(*(v.to(device) for v in (constant, rest)), 0.5, position.to(device), camera).cpu()
    assert color.isnan().tolist() == [[False] * 3, [False, False, True], [True, False, False]]

    features, alpha = torch.full((16, 20, 11), 0.5), torch.ones(16, 20)
    features[..., -3:] = torch.from_numpy(camera.position).float() + scenes.camera_rays(camera)
    for channel in range(8):  # the channels of normal, base colour, metallic and roughness
        features[channel, 10, channel] = nan
    light = Environment(torch.ones(6 * 16**2, 3, device=device))
    color = shade(features.to(device), alpha.to(device), light, camera, torch.zeros(3)).color.cpu()
    assert color[range(8), 10].isnan().any(dim=-1).all() and color[8:].isfinite().all()

    inputs = [v.to(device).requires_grad_() for v in scenes.surfels("plain", 3)]
    maps = rasterize(*inputs, camera, near=0.1)
    by = torch.autograd.grad(maps, inputs, [torch.full_like(m, nan) for m in maps])
    seen = torch.autograd.grad(rasterize(*inputs, camera, near=0.1).alpha.sum(), inputs[3])[0] != 0
    assert all(g[seen].isnan().any() and not g.isinf().any() and not (g.abs() > 1e30).any() for g in by)


def test_values_stay_within_limits(device):
    learned = Learned(brightest=3.0)
    learned.learn("environment", torch.zeros(40, device=device), by_row=False)
    value, learned.rates["environment"] = learned["environment"], 5.0
    for sign, ends in ((1, [3, -12]), (-1, [-12, 3])):  # a value at a limit leaves it when its gradient points away
        for _ in range(20):
            value.grad = sign * torch.linspace(-1, 1, 40, device=device)
            learned.step()
        assert value[[0, -1]].tolist() == ends and (float(value.max()), float(value.min())) == (3, -12)


def test_limits_keep_to_the_scenes_size():
    learned = Learned(2.0, LINEAR.brightest)
    assert learned.limits("position") == (-math.inf, math.inf)
    low, high = learned.limits("scale")
    assert math.exp(low) == pytest.approx(2e-6) and math.exp(high) == pytest.approx(200)
    assert Learned(1.0, SCREEN.brightest).limits("environment")[1] < learned.limits("environment")[1]


def test_a_mean_passes_over_what_is_no_number():
    none, mean = torch.tensor(math.nan), torch.tensor(2.0)
    assert float(running(mean, none)) == 2 and float(running(none, mean)) == 2
    assert float(running(mean, torch.tensor(3.0))) == pytest.approx(2.05)


@pytest.mark.parametrize(("decay", "opacity"), [(1.0, 0.05), (0.1, 0.2)])
def test_surfels_are_faint_until_what_the_picture_needs_can_be_back(decay, opacity):
    changes = ["densify.reset_every=100", "densify.stop=0.5", "rates.opacity=0.2", f"rates.decay={decay}"]
    settings = load_settings("paper", changes)
    moved = np.cumsum(0.2 * decay ** (np.arange(1000) / 1000))  # the most that Adam can have moved a logit
    way = 4 * math.log(opacity / (1 - opacity) * 0.99 / 0.01)

    def found(opacity: float, settings=settings) -> list[int]:
        return [i for i in range(1, 1000) if faint(settings.densify, settings.rates, i, 1000, opacity)]

    for last in (100, 200, 300, 400):
        those = [i for i in found(opacity) if last < i <= (last + 100 if last < 400 else 1000)]
        end = min(int(np.searchsorted(moved, moved[last] + way)), last + 101 if last < 400 else 1000)
        assert those == list(range(last + 1, last + 1 + len(those))) and those[-1] == pytest.approx(end, abs=2)
    assert not found(0.0) and not found(opacity, load_settings("paper", [*changes, "densify.reset_every=0"]))


def test_broken_surfels_are_removed_and_that_is_said(ball_capture, tmp_path):
    said = []
    made = trainer(ball_capture, "densify.every=1000", total=60, said=said, folder=tmp_path)
    made.run(stop=lambda: made.state.iteration >= 15)
    nan_value("roughness")(made)
    nan_value("position")(made)  # not drawn, so it has no gradient
    count = made.state.learned.count
    made.run(stop=lambda: made.state.iteration >= 30)
    broken = count - made.state.learned.count
    assert 4 <= broken <= 6 and all(v.isfinite().all() for v in made.state.learned.by_row.values())
    assert any("not taken" in line for line in said) and any("removed" in line for line in said)
    assert len(made.state.part(Densification).gradient.total) == made.state.learned.count


def test_a_broken_light_goes_back_to_the_checkpoint(ball_capture, tmp_path):
    said = []
    made = trainer(ball_capture, total=60, said=said, folder=tmp_path)
    made.run(stop=lambda: made.state.iteration >= 20)
    nan_value("environment")(made)
    assert made.run() and made.state.learned["environment"].isfinite().all()
    assert any("going back to that of 20" in line for line in said)


def test_a_training_that_cannot_go_on_ends_with_one_line(ball_capture, tmp_path):
    made = trainer(ball_capture, "train.checkpoint_every=1000", folder=tmp_path)
    nan_gradient("albedo", every=True)(made)
    with pytest.raises(InputError, match="no checkpoint yet") as error:
        made.run()
    assert "\n" not in str(error.value) and made.state.iteration <= MOST_IN_A_ROW + 10
    again = trainer(ball_capture, folder=tmp_path / "again")
    (tmp_path / "again").mkdir()
    again.run(stop=lambda: again.state.iteration >= 20)
    nan_gradient("albedo", every=True)(again)
    with pytest.raises(InputError, match="again after going back"):
        again.run()


def test_no_surfel_left_is_said():
    learned = Learned()
    learned.learn("position", torch.full((3, 3), math.nan))
    with pytest.raises(InputError, match="no surfel"):
        remove_broken(learned)


@pytest.mark.slow
def test_resumed_in_every_stage_it_is_the_same_run():
    found = resumed()
    assert found.finite and found.error == 0


@pytest.mark.parametrize(("scale", "offset"), [(1e-6, 0.0), (1e-6, 1.0), (1e6, 0.0), (1.0, 1e5), (1e3, -1e7)])
def test_a_capture_anywhere_is_learned_about_the_origin(scale, offset):
    """Check that cameras come out the same, up to rounding, wherever a capture lies and however large it is.

    Reading a capture moves and scales it. `to_capture` must map the cameras back to the capture's own coordinates.
    """

    def moved(pose: np.ndarray) -> np.ndarray:
        pose[:3, 3] = scale * pose[:3, 3] + offset
        return pose

    usual, found = read_capture(ball()), read_capture(changed(moved))
    assert np.array_equal(usual.to_capture, np.eye(4))  # a NeRF-Blender frame is kept if it suits float32
    assert np.abs(found.centre).max() < 1e-9 and found.radius == pytest.approx(1)
    lost = 1e-15 * (abs(offset) / scale + 1) + 1e-9
    for before, after in zip(usual.views, found.views, strict=True):
        there = found.to_capture @ np.append(after.camera.position, 1)
        assert np.abs((there[:3] - offset) / scale - before.camera.position).max() < 10 * lost
        assert np.abs(after.camera.position * usual.radius + usual.centre - before.camera.position).max() < 1e-3
        assert np.abs(after.camera.world_to_camera[:3, :3] - before.camera.world_to_camera[:3, :3]).max() < 1e-12
