"""Compare kernels with torch in float64: activating raw parameters, concatenating them, and averaging screen-space gradients."""

import numpy as np
import pytest
import torch

from refgs.model.surfels import activate, initial_parameters
from refgs.render.screen_gradient import ScreenGradient
from refgs.render.stack import stack
from tests.makers import scenes

COUNT = 5003
ACTIVATED = {"scale": (2,), "opacity": (), "albedo": (3,), "metallic": (), "roughness": ()}


def raw() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    values = {name: 6 * torch.randn(COUNT, *shape, generator=generator) for name, shape in ACTIVATED.items()}
    values["opacity"][:4] = values["metallic"][:4] = torch.tensor([-90, 90, -1e4, 1e4])
    rest = ("position", "rotation", "sh_dc", "sh_rest", "received", "indirect_dc", "indirect_rest")
    return values | dict.fromkeys(rest, torch.zeros(COUNT, 1))


@pytest.mark.parametrize("constant", [None, "metallic"])
def test_activations(device, constant):
    exact = {name: value.double().requires_grad_(name != constant) for name, value in raw().items()}
    expected = {name: exact[name].exp() if name == "scale" else exact[name].sigmoid() for name in ACTIVATED}
    expected["metallic"] = 3 * expected["metallic"] ** 2 - 2 * expected["metallic"] ** 3
    leaves = {name: value.to(device).requires_grad_(name != constant) for name, value in raw().items()}
    surfels = activate(leaves)
    values = surfels.scales, surfels.opacities, surfels.albedo, surfels.metallic, surfels.roughness
    got = dict(zip(ACTIVATED, values, strict=True))
    for name, value in got.items():
        assert ((value.cpu() - expected[name]).abs() <= 7e-7 * expected[name] + 1e-30).all(), name
        assert value.requires_grad == (name != constant), name
    learned = [name for name in ACTIVATED if name != constant]
    upstream = [torch.randn(got[n].shape, generator=torch.Generator().manual_seed(i)) for i, n in enumerate(learned)]
    by = torch.autograd.grad([got[n] for n in learned], [leaves[n] for n in learned], [u.to(device) for u in upstream])
    exact_by = torch.autograd.grad([expected[n] for n in learned], [exact[n] for n in learned], upstream)
    for name, g, reference in zip(learned, by, exact_by, strict=True):
        assert ((g.cpu() - reference).abs() <= 1e-6 * reference.abs() + 1e-6).all(), name


@pytest.mark.parametrize("metallic", [0.001, 0.2, 0.5, 0.97])
def test_a_start_has_the_material_that_is_asked_for(metallic):
    points = np.zeros((2, 3))
    look = {"opacity": 0.4, "sh_degree": 0, "albedo": 0.3, "metallic": metallic, "roughness": 0.6}
    surfels = activate(initial_parameters(points, np.array([[0, 0, 1.0]] * 2), np.ones(2), None, **look))
    got = [float(v[0].detach()) for v in (surfels.opacities, surfels.metallic, surfels.roughness, surfels.albedo[:, 0])]
    assert got == pytest.approx([0.4, metallic, 0.6, 0.3], rel=1e-4)


def test_side_by_side_and_apart(device):
    generator = torch.Generator().manual_seed(0)
    shapes = [(3,), (), (1,), (2,), ()]
    parts = [torch.randn(COUNT, *shape, generator=generator).to(device).requires_grad_() for shape in shapes]
    parts[3].requires_grad_(False)
    stacked = stack(parts)
    assert stacked.equal(torch.cat([part.reshape(COUNT, -1) for part in parts], dim=1))
    upstream = torch.randn(stacked.shape, generator=generator).to(device)
    learned = [part for part in parts if part.requires_grad]
    by = torch.autograd.grad(stacked, learned, upstream)
    columns = upstream.split([3, 1, 1, 2, 1], dim=1)
    assert all(g.equal(c.reshape(g.shape)) for g, c in zip(by, [columns[i] for i in (0, 1, 2, 4)], strict=True))


def test_motion_on_the_screen(device):
    generator = torch.Generator().manual_seed(0)
    positions, gradients = torch.randn(2, COUNT, 3, generator=generator)
    gradients[::3] = 0
    camera, motion = scenes.camera(), ScreenGradient(COUNT, device)
    matrix = torch.from_numpy(camera.world_to_camera)
    depth = (positions.double() @ matrix[2, :3] + matrix[2, 3]).clamp_min(0)
    length = (gradients.double() @ matrix[:2, :3].T).norm(dim=1)
    for _ in range(2):
        motion.add(positions.to(device), gradients.to(device), camera)
    expected = length * depth * camera.width / 2 / camera.fx
    torch.testing.assert_close(motion.total.cpu().double(), 2 * expected, rtol=1e-5, atol=1e-5)
    assert motion.views.cpu().equal(2.0 * (length > 0))
