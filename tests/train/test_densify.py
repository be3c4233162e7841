import numpy as np
import pytest
import torch

from refgs.camera import Camera
from refgs.model.learned import Learned
from refgs.model.surfels import activate, initial_parameters
from refgs.render.screen_gradient import ScreenGradient
from refgs.settings import load_settings
from refgs.train.learn.densify import densify

SETTINGS = load_settings("quick").densify


def make():
    """Learn 20 random surfels, a mask of them and a light, after one step of Adam for the surfels."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    parameters = initial_parameters(
        rng.normal(size=(20, 3)), normals, np.full(20, 0.1), None,
        opacity=0.5, sh_degree=1, albedo=0.5, metallic=0.5, roughness=0.3,
    )  # fmt: skip
    learned = Learned()
    for name, value in parameters.items():
        learned.learn(name, value)
    learned.learn("held", torch.arange(20) >= 18)
    learned.learn("environment", torch.zeros(6, 3), by_row=False)
    sum((learned[name] ** 2).sum() for name in parameters).backward()
    learned.step()
    learned.forget_gradients()
    return learned


def test_the_budget_holds_and_the_largest_gradients_go_first():
    learned = make()
    gradient = torch.linspace(0, 1, 20)
    divided = densify(learned, gradient, SETTINGS, budget=23, divide=True)
    assert divided == 3
    assert learned.count == 23 and all(len(value) == 23 for value in learned.by_row.values())
    assert learned["environment"].shape == (6, 3) and "environment" not in learned.by_row
    assert learned.moments.keys() == learned.by_row.keys() - {"held"}
    for moments in learned.moments.values():
        assert len(moments.mean) == len(moments.square) == 23
        assert (moments.mean[-6:] == 0).all() and (moments.square[-6:] == 0).all()
    assert (learned.moments["position"].mean[:17] != 0).any()
    assert learned["held"].nonzero()[:, 0].tolist() == [18, 19, 21, 22]  # both halves of what was held


def test_learning_again_starts_without_moments():
    learned = make()
    learned.rates["roughness"] = 0.3
    learned.drop("roughness", "absent")
    assert "roughness" not in learned and "roughness" not in learned.moments
    assert learned.constant["roughness"].shape == (1,)
    learned.learn("roughness", torch.zeros(20))
    assert "roughness" not in learned.constant and "roughness" not in learned.moments
    assert learned.rates["roughness"] == 0 and learned["roughness"].requires_grad
    learned.columns("sh_rest", 1)
    assert learned["sh_rest"].shape == learned.moments["sh_rest"].mean.shape == (20, 1, 3)
    learned.forget("scale", learned["held"])
    assert (learned.moments["scale"].square == 0).all(dim=1).nonzero()[:, 0].tolist() == [18, 19]
    learned.fill("opacity", 1.0)
    assert (learned["opacity"] == 1).all() and "opacity" not in learned.moments


def test_saved_and_loaded_it_is_the_same():
    """Check that a tensor left out or brought back after a checkpoint is made anew from it, and that nothing else changes."""
    kept, other = make(), make()
    tensors = {name: value.detach().clone() for name, value in kept.save().items()}
    other.drop("metallic", "environment")
    other.fill("scale", 0.0)
    other.load(tensors)
    assert torch.equal(other["scale"], kept["scale"]) and other.moments["scale"].steps == 1
    assert torch.equal(other.constant["metallic"], kept["metallic"][:1]) and "environment" not in other
    kept.drop("metallic")
    other.learn("metallic", torch.zeros(20))
    other.learn("environment", torch.ones(6, 3), by_row=False)
    other.load(kept.save())
    assert torch.equal(other["metallic"], kept.constant["metallic"].expand(20)) and "metallic" not in other.moments
    assert torch.equal(other["environment"], torch.zeros(6, 3))
    other.rates["environment"] = 0.3
    other.learn("environment", torch.ones(24, 3), by_row=False)
    assert other["environment"].shape == (24, 3) and other.rates["environment"] == 0.3
    with pytest.raises(KeyError):
        other.load({name: value for name, value in tensors.items() if name != "parameter.held"})


def test_a_division_keeps_the_variance():
    learned = make()
    with torch.no_grad():
        learned["scale"][:, 1] += 1.0  # make the second axis the longer one
    before = activate(learned.by_row)
    centre, sigma = before.positions[-1].detach().clone(), before.scales[-1].detach().clone()
    densify(learned, torch.eye(20)[-1], SETTINGS, budget=100, divide=True)
    after = activate(learned.by_row)
    pair = after.positions[[19, 20]].detach()
    torch.testing.assert_close(pair.mean(dim=0), centre)
    half = (pair[0] - pair[1]).norm() / 2
    torch.testing.assert_close(half**2 + after.scales[19, 1].detach() ** 2, sigma[1] ** 2)
    torch.testing.assert_close(after.scales[19, 0].detach(), sigma[0])
    along = (pair[0] - pair[1]) / (2 * half)
    assert abs(float(along @ before.normals()[-1])) < 1e-5


def test_faint_surfels_go_and_one_stays():
    learned = make()
    for count, faint, left in ((20, 5, 15), (15, 15, 1)):
        with torch.no_grad():
            learned["opacity"][:faint] = -20
        densify(learned, torch.zeros(count), SETTINGS, budget=100, divide=False)
        assert learned.count == left


def test_screen_gradient_is_by_pixels_of_motion():
    """Check the screen gradient, which decides where surfels are added: |dL/d(pixel position)| times half the image's width in pixels."""
    camera = Camera("a", 200, 100, 150.0, 150.0, 100.0, 50.0, np.eye(4))
    position = torch.tensor([[0.3, -0.2, 2.5]])
    wanted = torch.tensor([2.0, -1.0])  # dL/d(pixel)
    point = position.clone().requires_grad_()
    pixel = point[:, :2] / point[:, 2:].detach() * 150.0
    (pixel * wanted).sum().backward()
    motion = ScreenGradient(1, torch.device("cpu"))
    motion.add(position, point.grad, camera)
    torch.testing.assert_close(motion.mean(), wanted.norm()[None] * 100)
