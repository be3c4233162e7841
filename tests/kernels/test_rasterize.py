"""Compare the rasteriser with the float64 reference. Check determinism, surfels of equal depth, and empty or extreme input."""

import functools
import gc
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from refgs.kernels import load
from refgs.render import raster_cuda, reference
from refgs.render.rasterize import Raster, rasterize, trimmed_depth
from tests.makers import scenes
from tests.makers.emulate import emulate
from tests.makers.errors import check_near

NAMES = ("positions", "rotations", "scales", "opacities", "features")
# Thresholds (of alpha, of transmittance …) may be decided differently in float32. Pixels where a compared value is within MARGIN of
# its threshold are left out. Tests check that these pixels are few.
MARGIN = 1e-4
FORWARD, GRADIENT = 1e-5, 1e-4


@functools.cache
def case(kind: str, channels: int, size: tuple[int, int] = (45, 30), centre: tuple[float, float] | None = None):
    """Make random surfels, a camera and upstream gradients; run the float64 reference on them.

    `kind` is one of `scenes.KINDS`, `centre` the principal point. Return surfels, camera, the reference's maps, the mask of safe pixels,
    the upstream gradients and the reference's gradients. In a safe pixel no number is near a threshold with which it is compared, so
    rounding cannot change the pixel much.
    """
    camera, inputs = scenes.camera(*size, centre), scenes.surfels(kind, channels)
    exact = [v.double().requires_grad_() for v in inputs]
    *maps, margin = reference.rasterize(*exact, camera, scenes.NEAR)
    safe = margin > MARGIN
    torch.manual_seed(1)
    upstream = [torch.randn_like(m).float() * safe.reshape(safe.shape + (1,) * (m.ndim - 2)) for m in maps]
    gradients = torch.autograd.grad(maps, exact, [u.double() for u in upstream])
    return inputs, camera, [m.detach() for m in maps], safe, upstream, gradients


def run(device, inputs: tuple[Tensor, ...], camera, upstream: list[Tensor]) -> tuple[Raster, tuple[Tensor, ...]]:
    """Rasterise on a device and differentiate. Return the maps and the gradients, moved to the CPU."""
    inputs = [v.to(device, copy=True).requires_grad_() for v in inputs]
    raster = rasterize(*inputs, camera, near=scenes.NEAR)
    gradients = torch.autograd.grad(raster, inputs, [u.to(device) for u in upstream])
    return Raster(*(m.detach().cpu() for m in raster)), tuple(g.cpu() for g in gradients)


def check(device, inputs, camera, maps, safe, upstream, gradients) -> None:
    """Rasterise on a device. Check maps and gradients against the reference's, which `case` returns.

    Errors are relative to a tensor's largest value.
    """
    assert safe.float().mean() > 0.9
    raster, found = run(device, inputs, camera, upstream)
    assert all(expected[safe].abs().max() > 0.05 for expected in maps)
    check_near(raster._fields, [value[safe] for value in raster], [expected[safe] for expected in maps], FORWARD)
    check_near(NAMES, found, gradients, GRADIENT)


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_matches_reference(kind, device):
    check(device, *case(kind, scenes.CHANNELS[kind]))


@pytest.mark.parametrize("channels", [1, 2, 3, 7, 12, 16, 20, 33])
def test_any_number_of_channels(channels, device):
    check(device, *case("plain", channels))


@pytest.mark.parametrize(
    ("kind", "size", "centre"),
    [
        ("mixed", (17, 40), None),
        ("mixed", (33, 20), (-25.0, 60.0)),
        ("mixed", (1, 1), None),
        ("huge", (140, 130), None),  # each surfel covers up to 81 tiles; a CUDA warp sums more than 64
    ],
)
def test_any_image(kind, size, centre, device):
    check(device, *case(kind, 3, size, centre))


@pytest.mark.parametrize("kind", scenes.KINDS)
@pytest.mark.parametrize("trim", [(0.75, 0.25), (1.0, 0.6)])
def test_trimmed_depth_matches_reference(kind, trim, device):
    camera, (*inputs, _) = scenes.camera(), scenes.surfels(kind, 0)
    exact = [v.double() for v in inputs]
    _, depth, alpha, margin = reference.rasterize(*exact, exact[-1][:, None], camera, scenes.NEAR, *trim)
    found = [m.cpu() for m in trimmed_depth(*(v.to(device) for v in inputs), camera, scenes.NEAR, *trim)]
    part = trim[0] - (1 - alpha).clamp(*trim[::-1])
    safe = (margin > MARGIN) & ((part > 0.01) | (part == 0))  # a small part keeps few digits in float32
    assert safe.float().mean() > 0.85 and part[safe].max() > 0.05
    expected = torch.where(part > 0, depth / part, 0)[safe]
    assert (found[0][safe] - expected).abs().max() <= 1e-4 * expected.max()
    assert (found[1] - alpha)[margin > MARGIN].abs().max() <= FORWARD


def test_trimmed_depth_is_that_of_the_surface(device):
    """Check that `trimmed_depth` is the surface's depth, in spite of fog in front and a disc 1000 times as far behind.

    The fog and the disc both change the mean depth.
    """
    camera = replace(scenes.camera(9, 9, (4.5, 4.5)), world_to_camera=np.eye(4))
    depths, opacities = torch.tensor([0.5, 0.7, 2.0, 2000.0]), torch.tensor([0.1, 0.1, 0.9, 0.9])
    positions = torch.stack([0 * depths, 0 * depths, depths], dim=1)
    flat, wide = torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1), 100 * depths[:, None].repeat(1, 2)
    inputs = [v.to(device) for v in (positions, flat, wide, opacities)]
    trimmed, alpha = trimmed_depth(*inputs, camera, scenes.NEAR, 0.75, 0.25)
    mean = rasterize(*inputs, inputs[-1][:, None], camera, scenes.NEAR).depth / alpha
    assert (trimmed.cpu() - 2).abs().max() < 1e-4 and mean.min() > 100


def test_more_tiles_than_16_bits_number(monkeypatch):
    """Check sorting with tile numbers of more than 16 bits, as images of over eight million pixels need."""
    emulate(monkeypatch)
    monkeypatch.setattr(raster_cuda, "SHORT", 0)
    check(torch.device("cpu"), *case("mixed", 3, (33, 20), (-25.0, 60.0)))


def test_instruction_sets_differ(monkeypatch):
    """Check that each value of REFGS_ISA, the variable that chooses an instruction set, loads another library.

    The `device` fixture relies on this.
    """
    paths = set()
    for isa in load.supported():
        monkeypatch.setenv("REFGS_ISA", isa)
        paths.add(load.kernels()._name)
    assert len(paths) == len(load.supported())


def test_reference_gradients():
    """Check that the derivatives of the float64 reference agree with finite differences."""
    inputs, camera, *_ = case("mixed", 2, (11, 8))
    exact = [v[::12].double().requires_grad_() for v in inputs]
    margin = reference.rasterize(*exact, camera, scenes.NEAR)[3]

    def safe_maps(*values):
        *maps, _ = reference.rasterize(*values, camera, scenes.NEAR)
        return tuple(m[margin > 1e-3] for m in maps)

    assert (margin > 1e-3).sum() > 40
    assert torch.autograd.gradcheck(safe_maps, exact, eps=1e-8, atol=1e-4, rtol=1e-3, nondet_tol=0)


@pytest.mark.parametrize("private_pool", [False, True])
def test_same_bits_for_any_number_of_threads(private_pool, device, monkeypatch):
    if private_pool:
        monkeypatch.setattr(load, "_openmp", lambda: None)
    inputs, camera = scenes.surfels("mixed", 16), scenes.camera(90, 60)
    upstream = [torch.ones(60, 90, 16), torch.ones(60, 90), torch.ones(60, 90)]

    def all_of_it() -> list[Tensor]:
        raster, gradients = run(device, inputs, camera, upstream)
        return [*raster, *gradients]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)


def test_shares_torchs_threads():
    if sys.platform != "linux":
        pytest.skip("torch's OpenMP is not GNU's here")
    assert load._openmp() is not None


def test_ties_are_drawn_in_order(device):
    position, rotation = torch.tensor([[0.0, 0, 1]] * 2), torch.tensor([[1.0, 0, 0, 0]] * 2)
    inputs = position, rotation, torch.ones(2, 2), torch.full((2,), 0.8), torch.eye(2)
    first, second = rasterize(*(v.to(device) for v in inputs), scenes.camera(9, 9), near=0.1).features.unbind(-1)
    assert (first > second).all() and (second > 0).all()


@pytest.mark.parametrize("where", ["none", "behind", "beside", "transparent"])
def test_nothing_to_see(where, device):
    inputs = list(scenes.surfels("plain", 3))
    if where == "none":
        inputs = [v[:0] for v in inputs]
    inputs[0] = inputs[0] + torch.tensor({"behind": [0.0, 0, -50], "beside": [1000.0, 0, 0]}.get(where, [0.0, 0, 0]))
    if where == "transparent":
        inputs[3] = torch.full_like(inputs[3], 1 / 256)
    upstream = [torch.ones(30, 45, 3), torch.ones(30, 45), torch.ones(30, 45)]
    raster, gradients = run(device, tuple(inputs), scenes.camera(), upstream)
    assert all((m == 0).all() for m in raster)
    assert all(g.shape == v.shape and (g == 0).all() for g, v in zip(gradients, inputs, strict=True))


def test_absurd_input_stays_finite(device):
    torch.manual_seed(0)
    sizes = torch.tensor([0, 1e-45, 1e-38, 1e-20, 1e-6, 1e-2, 1, 1e3, 1e10, 1e20, 3e38])
    n = 4000
    scale = sizes[torch.randint(len(sizes), (n, 2))]
    sign = torch.randn(n, 3).sign()
    position = torch.randn(n, 3) * 0.3 + torch.tensor([0.3, -0.2, 0.6])
    far = torch.arange(n) % 3 == 0
    position[far] = (sign * sizes[torch.randint(len(sizes), (n, 3))])[far]
    rotation = torch.randn(n, 4) * sizes[torch.randint(len(sizes), (n, 1))].clamp_max(1e37)
    rotation[::5] = torch.tensor([1.0, 0, 0, 0])  # many are exactly edge-on for an unrotated camera
    opacity = torch.rand(n)
    opacity[::7], opacity[1::7], opacity[2::7] = 0, 1, 1e-45
    for camera in (scenes.camera(), scenes.camera(1, 40)):
        shape = (camera.height, camera.width)
        upstream = [torch.randn(*shape, 3), torch.randn(shape), torch.randn(shape)]
        raster, gradients = run(device, (position, rotation, scale, opacity, torch.randn(n, 3)), camera, upstream)
        assert all(value.isfinite().all() for value in (*raster, *gradients))
        assert 0.5 < raster.alpha.max() <= 1 + 1e-5


def test_exactly_edge_on_is_a_dot(device):
    """Check that a disc seen exactly edge-on is drawn by the low-pass filter alone, at the depth of its centre."""
    camera = scenes.camera(9, 9, (4.5, 4.5))
    centre = torch.tensor(camera.camera_to_world @ [0, 0, 2, 1], dtype=torch.float64)[:3]
    right, down, forward = camera.camera_to_world[:3, :3].T
    matrix = np.stack([right, forward, -down], axis=1)
    rotation = torch.tensor(Rotation.from_matrix(matrix).as_quat(scalar_first=True)).float()
    inputs = centre.float()[None], rotation[None], torch.full((1, 2), 0.3), torch.ones(1), torch.ones(1, 1)
    raster = Raster(*(m.cpu() for m in rasterize(*(v.to(device) for v in inputs), camera, near=0.1)))
    y, x = torch.meshgrid(torch.arange(9) - 4.0, torch.arange(9) - 4.0, indexing="ij")
    expected = torch.exp(-4 * (x**2 + y**2)).clamp_max(0.99)  # the low-pass filter: a Gaussian of variance 1/8
    expected = torch.where(expected >= 1 / 255, expected, 0)[y != 0]
    assert torch.allclose(raster.alpha[y != 0], expected, atol=1e-5)
    assert torch.allclose(raster.depth[y != 0], 2 * expected, atol=1e-4)


def _bytes_of_tensors() -> int:
    gc.collect()
    return sum(v.untyped_storage().nbytes() for v in gc.get_objects() if type(v) is torch.Tensor)


def test_no_grad_keeps_nothing():
    inputs, camera = scenes.surfels("mixed", 16), scenes.camera(64, 64)
    before = _bytes_of_tensors()
    with torch.no_grad():
        raster = rasterize(*[v.requires_grad_() for v in inputs], camera, near=0.1)
    assert raster.features.grad_fn is None
    assert _bytes_of_tensors() - before <= 64 * 64 * (16 + 1 + 1) * 4
    assert not rasterize(*[v.detach() for v in inputs], camera, near=0.1).alpha.requires_grad


def test_wrong_shapes_are_refused():
    positions, rotations, *rest = scenes.surfels("plain", 3)
    with pytest.raises(ValueError, match="float32"):
        rasterize(positions.double(), rotations, *rest, scenes.camera(), near=0.1)
    with pytest.raises(ValueError, match="rotations"):
        rasterize(positions, rotations[:, :3], *rest, scenes.camera(), near=0.1)
    with pytest.raises(ValueError, match="near"):
        rasterize(positions, rotations, *rest, scenes.camera(), near=0.0)
