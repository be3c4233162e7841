import numpy as np
import torch

from refgs.camera import Camera
from refgs.model.adam import Adam
from refgs.model.surfels import activate, initial_parameters
from refgs.settings import load_settings
from refgs.train.learn.densify import densify
from refgs.train.screen_gradient import ScreenGradient

SETTINGS = load_settings("quick").densify


def make():
    """Make the parameters of 20 random surfels, and an Adam optimiser after one step.

    The optimiser also holds the parameter `environment`, a light.
    """
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    parameters = initial_parameters(
        rng.normal(size=(20, 3)), normals, np.full(20, 0.1), None,
        opacity=0.5, sh_degree=1, albedo=0.5, metallic=0.5, roughness=0.3,
    )  # fmt: skip
    groups = [{"params": [value], "name": name} for name, value in parameters.items()]
    groups.append({"params": [torch.zeros(6, 3, requires_grad=True)], "name": "environment"})
    optimizer = Adam(groups)
    sum((value**2).sum() for value in parameters.values()).backward()
    optimizer.step()
    return parameters, optimizer


def test_the_budget_holds_and_the_largest_gradients_go_first():
    parameters, optimizer = make()
    gradient = torch.linspace(0, 1, 20)
    divided = densify(parameters, optimizer, gradient, SETTINGS, budget=23, divide=True)
    assert divided == 3
    assert all(len(value) == 23 for value in parameters.values())
    *groups, light = optimizer.param_groups
    assert light["params"][0].shape == (6, 3)
    for group in groups:
        assert group["params"][0] is parameters[group["name"]]
        state = optimizer.state[group["params"][0]]
        assert len(state["exp_avg"]) == 23
        assert (state["exp_avg"][-6:-3] == 0).all() and (state["exp_avg"][-3:] == 0).all()
    assert (optimizer.state[parameters["position"]]["exp_avg"][:17] != 0).any()


def test_a_division_keeps_the_variance():
    parameters, optimizer = make()
    with torch.no_grad():
        parameters["scale"][:, 1] += 1.0  # make the second axis the longer one
    before = activate(parameters)
    centre, sigma = before.positions[-1].detach().clone(), before.scales[-1].detach().clone()
    densify(parameters, optimizer, torch.eye(20)[-1], SETTINGS, budget=100, divide=True)
    after = activate(parameters)
    pair = after.positions[[19, 20]].detach()
    torch.testing.assert_close(pair.mean(dim=0), centre)
    half = (pair[0] - pair[1]).norm() / 2
    torch.testing.assert_close(half**2 + after.scales[19, 1].detach() ** 2, sigma[1] ** 2)
    torch.testing.assert_close(after.scales[19, 0].detach(), sigma[0])
    along = (pair[0] - pair[1]) / (2 * half)
    assert abs(float(along @ before.normals()[-1])) < 1e-5


def test_faint_surfels_go_and_one_stays():
    parameters, optimizer = make()
    for count, faint, left in ((20, 5, 15), (15, 15, 1)):
        with torch.no_grad():
            parameters["opacity"][:faint] = -20
        densify(parameters, optimizer, torch.zeros(count), SETTINGS, budget=100, divide=False)
        assert len(parameters["position"]) == left


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
