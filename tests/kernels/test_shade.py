"""Compare deferred shading with the float64 reference; test that a white surface conserves energy (white furnace)."""

import functools

import numpy as np
import pytest
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model.environment import Environment
from refgs.render import reference
from refgs.render.shade import mirror_directions, shade, shade_splats
from tests.makers import scenes
from tests.makers.errors import check_near

NAMES = ("features", "alpha", "levels", "exposure")
# Shading has kinks, where derivatives jump. Pixels within MARGIN of one are left out of the gradients; tests check that they are few.
MARGIN = 1e-4
FORWARD, GRADIENT = 1e-5, 1e-4
BACKGROUND = torch.tensor([0.2, 0.5, 1.0])
EXPOSURE = [0.7, 0.9, 0.6]
TURN = reference.rotation_matrices(torch.tensor([[0.8, 0.3, -0.4, 0.5]], dtype=torch.float64))[0]


class Light:
    """Stand in for an Environment: random light whose prefiltered levels and exposure require gradients."""

    def __init__(self, dtype: torch.dtype, device: torch.device | str = "cpu", resolution: int = 16):
        generator = torch.Generator().manual_seed(2)
        exact = Environment(torch.exp(0.5 * torch.randn(6 * resolution**2, 3, generator=generator)))
        self.sides = exact.sides
        self.levels = exact.levels.to(device, dtype).requires_grad_()
        self.exposure = torch.tensor(EXPOSURE, dtype=dtype, device=device).requires_grad_()

    def turn(self, camera: Camera) -> np.ndarray:
        return TURN.numpy()


def means(camera: Camera, colours: int) -> tuple[Tensor, Tensor]:
    """Make smooth random maps for shading: features (H, W, C) and alpha (H, W). A third of the pixels is empty.

    The features are the normal, the material, `colours` RGB colours and a position, in this order. The position projects up to ten pixels
    away from its own pixel.
    """
    generator = torch.Generator().manual_seed(1)

    def uniform(channels: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        coarse = torch.rand(1, channels, -(-camera.height // 5), -(-camera.width // 5), generator=generator)
        smooth = torch.nn.functional.interpolate(coarse, (camera.height, camera.width), mode="bilinear")
        return low + (high - low) * smooth[0].permute(1, 2, 0)

    view = torch.from_numpy(camera.world_to_camera).float()
    shift = uniform(2, -10, 10) * uniform(1) ** 2 / torch.tensor([camera.fx, camera.fy])
    rays = scenes.camera_rays(camera) + shift @ view[:2, :3]
    position = torch.from_numpy(camera.position).float() + uniform(1, 1.5, 4) * rays
    normal = (-view[2, :3] + uniform(3, -0.7, 0.7)) * uniform(1, 0.5, 1)
    parts = [normal, uniform(5), *([uniform(3 * colours, 0, 2)] if colours else []), position]
    alpha = (uniform(1, -0.5, 1).clamp_min(0))[..., 0]
    return torch.cat(parts, dim=-1), alpha


@functools.cache
def case(appearance: bool, indirect: bool, size: tuple[int, int]):
    """Make random maps of features and alpha, a camera and upstream gradients; run the float64 reference on them.

    If `appearance`, pixels have a view-dependent colour, which replaces diffuse shading. If `indirect`, a visibility map has free, occluded
    and partly occluded pixels.

    Return camera, (features, alpha), visibility, the reference's maps, the mask of safe pixels, the upstream gradients and the reference's
    gradients. A pixel is safe if it is not near a kink, where derivatives jump.
    """
    camera = scenes.camera(*size)
    mean, alpha = means(camera, 2 if indirect else int(appearance))
    inputs = (mean * alpha[..., None], alpha)
    light = Light(torch.float64)
    exact = [*(v.double().requires_grad_() for v in inputs), light.levels, light.exposure]
    visibility = None
    if indirect:
        visibility = (2 * torch.rand(alpha.shape, generator=torch.Generator().manual_seed(4)) - 0.5).clamp(0, 1)
    background, how = BACKGROUND.double(), {"by_direction": appearance}
    *maps, margin = reference.shade(*exact[:3], light.sides, camera, background, visibility, exact[3], TURN, **how)
    safe = margin > MARGIN
    generator = torch.Generator().manual_seed(3)
    upstream = [torch.randn(m.shape, generator=generator) * safe[..., None] for m in maps[:3]]
    gradients = torch.autograd.grad(maps[:3], exact, [u.double() for u in upstream])
    return camera, inputs, visibility, [m.detach() for m in maps], safe, upstream, gradients


def run(camera, inputs, visibility, upstream, device, by_direction=False) -> tuple[list[Tensor], list[Tensor]]:
    """Shade the inputs (features, alpha) on a device and differentiate. Return the maps and the gradients, moved to the CPU.

    `visibility` and `by_direction` are arguments of `shade`. `upstream` are the upstream gradients.
    """
    light = Light(torch.float32, device)
    leaves = [*(v.to(device).clone().requires_grad_() for v in inputs), light.levels, light.exposure]
    visibility = None if visibility is None else visibility.to(device)
    shaded = shade(*leaves[:2], light, camera, BACKGROUND, visibility, light.exposure, by_direction=by_direction)
    gradients = torch.autograd.grad(shaded[:3], leaves, [u.to(device) for u in upstream])
    return [s.detach().cpu() for s in shaded], [g.cpu() for g in gradients]


@pytest.mark.parametrize("size", [(45, 30), (37, 70), (9, 4)])
@pytest.mark.parametrize("appearance", [False, True])
@pytest.mark.parametrize("indirect", [False, True])
def test_matches_reference(indirect, appearance, size, device):
    camera, inputs, visibility, maps, safe, upstream, gradients = case(appearance, indirect, size)
    assert safe.float().mean() > 0.9
    found, by = run(camera, inputs, visibility, upstream, device, appearance)
    check_near(("color", "normal", "material", "radiance"), [v[safe] for v in found], [v[safe] for v in maps], FORWARD)
    check_near(NAMES, by, gradients, GRADIENT)


@pytest.mark.parametrize("how", ["display", "mirror", "matte"])
def test_other_ways_match_reference(how, device):
    """Check three options of `shade` against the reference.

    With "display", light and materials are already display values, so the result is not encoded as sRGB. With "mirror", surfaces are sharp
    mirrors: metallic blends their own colour with the mirrored light. With "matte", nothing is specular.
    """
    by_direction = how != "matte"
    camera, (features, alpha), *_ = case(by_direction, False, (45, 30))
    features = features if by_direction else features[..., :6].contiguous()
    options = {"by_direction": by_direction, how: True}
    inputs, light = (features, alpha), Light(torch.float64)
    exact = [*(v.double().requires_grad_() for v in inputs), light.levels]
    picture, *_, margin = reference.shade(*exact, light.sides, camera, BACKGROUND.double(), turn=TURN, **options)
    safe = margin > MARGIN
    upstream = torch.randn(picture.shape, generator=torch.Generator().manual_seed(5)) * safe[..., None]
    assert safe.float().mean() > 0.9
    light = Light(torch.float32, device)
    leaves = [*(v.to(device).clone().requires_grad_() for v in inputs), light.levels]
    found = shade(*leaves[:2], light, camera, BACKGROUND, **options).color
    check_near(["picture"], [found[safe]], [picture[safe]], FORWARD)
    wanted = torch.autograd.grad(picture, exact, upstream.double())
    check_near(NAMES[:3], torch.autograd.grad(found, leaves, upstream.to(device)), wanted, GRADIENT)


@pytest.mark.parametrize("more", [0, 5, 8], ids=["matte", "material", "and colour"])
@pytest.mark.parametrize("count", [1, 1000])
def test_surfels_match_reference(count, more, device):
    camera, generator = scenes.camera(20, 30), torch.Generator().manual_seed(6)
    position = torch.randn(count, 3, generator=generator)
    towards = torch.nn.functional.normalize(torch.from_numpy(camera.position).float() - position, dim=-1)
    normal = (towards + 0.4 * torch.randn(count, 3, generator=generator)) * 1.5
    material = torch.rand(count, more or 3, generator=generator)
    features = torch.cat([normal, material, position] if more else [normal, material], dim=1)
    light = Light(torch.float64)
    exact = [features.double().requires_grad_(), light.levels]
    expected, margin = reference.shade_splats(exact[0], light.levels, light.sides, camera, TURN)
    safe = (margin > MARGIN)[:, None]
    assert safe.float().mean() > 0.8
    upstream = torch.randn(count, 3, generator=generator) * safe
    light = Light(torch.float32, device)
    leaves = [features.to(device).requires_grad_(), light.levels]
    found = shade_splats(leaves[0], light, camera)
    assert ((found.detach().cpu() - expected).abs() * safe).max() <= FORWARD * expected.abs().max()
    wanted = torch.autograd.grad(expected, exact, upstream.double())
    check_near(("features", "levels"), torch.autograd.grad(found, leaves, upstream.to(device)), wanted, GRADIENT)


def test_mirror_directions(device):
    """Check mirror directions: a pixel's ray is mirrored at the blended normal. In an empty pixel the direction is zero."""
    camera, (features, alpha), _, maps, _, _, _ = case(False, True, (37, 70))
    covered = alpha > reference.COVERED
    normal, ray = reference.unit(maps[1][covered]), reference.unit(scenes.camera_rays(camera)[covered].double())
    expected = ray - 2 * (ray * normal).sum(dim=-1, keepdim=True) * normal
    found = mirror_directions(features.to(device), alpha.to(device), camera).cpu()
    assert (found[covered] - expected).abs().max() <= FORWARD
    assert found[~covered].eq(0).all()


def test_same_bits_from_call_to_call_for_any_number_of_threads(device):
    camera, inputs, visibility, _, _, upstream, _ = case(False, True, (37, 70))

    def all_of_it() -> list[Tensor]:
        maps, gradients = run(camera, inputs, visibility, upstream, device)
        return [*maps, *gradients]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1e10, 1e30])
def test_gradients_of_any_size(scale, device):
    """Check that gradients keep their precision if they are tiny, huge, or tiny beside huge ones.

    This is not obvious, because the kernels sum gradients as integers.
    """
    camera, inputs, visibility, _, _, upstream, gradients = case(False, False, (37, 70))
    _, by = run(camera, inputs, visibility, [u * scale for u in upstream], device)
    check_near(NAMES, [value / scale for value in by], gradients, GRADIENT)
    mixed = [u.clone() for u in upstream]
    for u in mixed:
        u[:35] *= 1e-6
    small, large = (run(camera, inputs, visibility, u, device)[1][0] for u in (mixed, upstream))
    reach = slice(0, 35 - 10)  # rows out of reach of the large gradients below
    assert (1e6 * small[reach] - large[reach]).abs().max() <= GRADIENT * large[reach].abs().max()


def test_upstream_that_is_no_number(device):
    """Check NaN and infinite upstream gradients: the gradients then hold values that are not finite. The shaded maps stay finite."""
    camera, inputs, visibility, _, _, upstream, _ = case(False, False, (45, 30))
    for wrong in (float("nan"), float("inf")):
        for u in (given := [u.clone() for u in upstream]):
            u[10:20] = wrong
        maps, by = run(camera, inputs, visibility, given, device)
        assert all(m.isfinite().all() for m in maps) and not any(b.isfinite().all() for b in by)


@pytest.mark.parametrize("focal", [50, 100, 200])
@pytest.mark.parametrize(("kind", "wanted", "tolerance"), [("curve", -1.5, 0.1), ("edge", 0, 4)])
def test_normals_are_displaced_on_curves_and_not_at_edges(kind, wanted, tolerance, focal, device):
    """Check a pixel's normal where its blend belongs to a surface point 0.03 to the right, after which the surface turns.

    It is the normal as far to the left on a curve, which turns by 50 degrees over a length of 1, and the pixel's own beyond an edge of 60
    degrees. `wanted` is its angle from the pixel's own, in degrees. It is the same in pictures of all sizes, given by the focal length in
    pixels.
    """
    height, width = 4, 40
    camera = Camera("wide", width, height, focal, focal, width / 2, height / 2, np.eye(4))
    columns = torch.arange(width)
    own = torch.deg2rad(50 / focal * columns if kind == "curve" else 60.0 * (columns >= 20) - 30.0)
    normal = torch.stack([own.sin(), torch.zeros(width), -own.cos()], dim=-1).expand(height, width, 3)
    position = scenes.camera_rays(camera) + torch.tensor([0.03, 0, 0])
    features = torch.cat([normal, torch.full((height, width, 5), 0.5), position], dim=-1).to(device)
    shaded = shade(features, torch.ones(height, width, device=device), Light(torch.float32, device), camera, BACKGROUND)
    found = torch.atan2(shaded.normal[..., 0], -shaded.normal[..., 2]).cpu() - own
    assert (torch.rad2deg(found[:, 20:23]) - wanted).abs().max() < tolerance


def test_nothing_there(device):
    camera = scenes.camera(20, 10)
    leaves = [torch.zeros(*size, device=device, requires_grad=True) for size in ((10, 20, 11), (10, 20))]
    shaded = shade(*leaves, Light(torch.float32, device), camera, BACKGROUND)
    assert torch.equal(shaded.color.cpu(), BACKGROUND.expand(10, 20, 3)) and shaded.normal.eq(0).all()
    by = torch.autograd.grad(shaded.color.sum(), leaves)
    assert all(b.eq(0).all() for b in by)


def test_one_pixel(device):
    """Check images of a single pixel, row or column, in which pixels lack neighbours to interpolate between."""
    light, mean = Light(torch.float32, device), torch.tensor([0, 0, -1, 0.5, 0.5, 0.5, 0, 0.5, 0, 0, 3.0])
    for size in ((1, 1), (1, 5), (5, 1)):
        camera = Camera("small", *size, 50, 50, size[0] / 2, size[1] / 2, np.eye(4))
        features = mean.to(device).expand(size[1], size[0], 11).clone().requires_grad_()
        alpha = torch.ones(size[1], size[0], device=device)
        shaded = shade(features, alpha, light, camera, BACKGROUND)
        assert (shaded.material - mean.to(device)[3:8]).abs().max() <= FORWARD
        (by,) = torch.autograd.grad(shaded.normal.sum(), features)
        assert (by[..., :3].sum(dim=(0, 1)) - size[0] * size[1]).abs().max() <= 1e-4


def white_ball(metallic: float, roughness: float, side: int = 64) -> Tensor:
    """Shade a white ball under a light of radiance 1, seen by a nearly orthographic camera. Return the radiance of its pixels.

    The image has `side` × `side` pixels.
    """
    camera = Camera("far", side, side, 1e4, 1e4, side / 2, side / 2, np.eye(4))
    y, x = torch.meshgrid(*[(torch.arange(side) + 0.5) / side * 2 - 1] * 2, indexing="ij")
    inside = x**2 + y**2 < 1
    normal = torch.stack([x, y, -torch.sqrt((1 - x**2 - y**2).clamp_min(0))], dim=-1)
    position = scenes.camera_rays(camera)  # at a depth of 1
    material = torch.tensor([1.0, 1.0, 1.0, metallic, roughness]).expand(side, side, 5)
    alpha = inside.float()
    features = torch.cat([normal, material, position], dim=-1) * alpha[..., None]
    return shade(features, alpha, Environment(torch.ones(6 * 16**2, 3)), camera, torch.zeros(3)).radiance[inside]


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 1.0])
def test_white_furnace(metallic, roughness):
    """Check that a white surface under a light of radiance 1 has radiance 1 at every angle, to 0.001.

    This includes light that bounces several times between microfacets.
    """
    radiance = white_ball(metallic, roughness)
    assert float(radiance.max()) <= 1 + 1e-3 and float(radiance.min()) >= 1 - 1e-3
