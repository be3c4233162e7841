"""Compare the training's objective and its gradients with plain torch in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from refgs.color import srgb_decode, srgb_encode
from refgs.render import reference as oracle
from refgs.render.reference import unit
from refgs.render.renderer import COVERED, Rendering
from refgs.settings import LossSettings
from refgs.train.learn.losses import objective
from refgs.train.photo import Photo
from tests.makers import scenes
from tests.makers.emulate import emulate
from tests.makers.training import only

FLAT = 0.01
ALL = LossSettings(
    dssim=0.2,
    normal=0.3,
    smooth=0.4,
    even=0.25,
    alpha=0.5,
    metallic=0.6,
    matte=0.7,
    light=0.0,
    prior=0.0,
    outlines=0.0,
    mesh=0.0,
    exposure=0.0,
)
BACKGROUND = torch.tensor([0.2, 0.5, 1.0])
MAPS = ("color", "normal", "blended_depth", "alpha", "material")


def huber(difference: Tensor) -> Tensor:
    return torch.nn.functional.huber_loss(difference, torch.zeros_like(difference), reduction="none", delta=FLAT) / FLAT


def reference(rendering: Rendering, view: Photo, weights: LossSettings, progress: float) -> dict[str, Tensor]:
    """Compute every weighted term of the training's loss in float64, by name. The tests compare the program with these values."""
    photo, bound = view.image.double() / view.white, view.image.int() == torch.iinfo(view.image.dtype).max
    mask = None if view.mask is None else view.mask.double() / 255
    if mask is not None:
        photo = photo * mask[..., None] + BACKGROUND.double() * (1 - mask[..., None])
        bound &= mask[..., None] >= 0.5
    color = torch.where(bound, rendering.color.minimum(photo), rendering.color)
    terms = {"l1": (1 - weights.dssim) * (color - photo).abs().mean()}
    terms["dssim"] = weights.dssim * oracle.dssim(color, photo)

    solid = rendering.alpha.detach() > 0.5
    if min(solid.shape) > 2:
        points = scenes.camera_rays(view.camera).double() * rendering.depth[..., None]
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        towards = unit(torch.linalg.cross(down, across))
        apart = 1 - (towards * unit(rendering.normal[1:-1, 1:-1])).sum(dim=-1)
        around = solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
        terms["normal"] = weights.normal * (apart * around).mean()
    for axis, n in enumerate(solid.shape):
        if n < 2:
            continue

        def step(v: Tensor, axis: int = axis, n: int = n) -> Tensor:
            return (v.narrow(axis, 1, n - 1) - v.narrow(axis, 0, n - 1)).abs().sum(dim=-1)

        both = solid.narrow(axis, 1, n - 1) & solid.narrow(axis, 0, n - 1)
        kept = torch.exp(-step(photo)) * both
        terms[f"smooth {axis}"] = weights.smooth * (step(rendering.normal) * kept).mean()
        if rendering.material is not None:
            change = huber(rendering.material[..., 3:].diff(dim=axis))
            terms[f"even {axis}"] = weights.even * (change.sum(dim=-1) * kept).mean()
    if mask is not None:
        terms["alpha"] = weights.alpha * (rendering.alpha - mask).abs().mean()
    if rendering.material is not None:
        m, covered = rendering.metallic, (rendering.alpha.detach() > COVERED).sum().clamp_min(1)
        terms["metallic"] = weights.metallic * progress**2 * (m * (1 - m)).sum() / covered
        terms["matte"] = weights.matte * huber((rendering.roughness - 0.3).clamp_min(0)).sum() / covered
    return terms


def pictures(width: int, height: int, masked: bool, material: bool) -> tuple[Rendering, Photo]:
    """Make a rendering of a bumpy, partly transparent surface, and a random photo of the same size.

    Some colours of the rendering are above 1, and some of the photo are clipped.
    """
    rng, camera = np.random.default_rng([width, height]), scenes.camera(width, height)

    def random(*shape: int) -> Tensor:
        return torch.tensor(rng.uniform(size=shape), dtype=torch.float32)

    size = height, width
    y, x = torch.meshgrid(torch.arange(height) / 7, torch.arange(width) / 5, indexing="ij")
    depth = 2.5 + 0.3 * torch.sin(x) * torch.cos(y) + 0.01 * random(*size)
    normal = torch.tensor(camera.world_to_camera[2, :3] * -1).float() + 0.6 * (random(*size, 3) - 0.5)
    alpha = (random(*size) + 0.4).clamp_max(1) - 0.003 * random(*size)
    materials = random(*size, 5)
    maps = [1.2 * random(*size, 3), alpha, depth * alpha, normal, materials if material else None]
    photo, mask = (torch.tensor((300 * rng.uniform(size=s)).clip(0, 255)).byte() for s in ((*size, 3), size))
    return Rendering(*maps), Photo(photo, mask if masked else None, camera)


def with_16_bits(view: Photo, white: int) -> Photo:
    """Give a photo 16-bit codes between those that it has. `white` is the code of white, and some brighter codes are the largest."""
    between = torch.randint(257, view.image.shape, generator=torch.Generator().manual_seed(0))
    codes = torch.where(view.image == 255, 65535, view.image * (white // 255) + between * (white // 255) // 257)
    return view._replace(image=codes.to(torch.uint16), white=white)


def moved(view: Photo, device: torch.device) -> Photo:
    return view._replace(image=view.image.to(device), mask=None if view.mask is None else view.mask.to(device))


def leaves(rendering: Rendering, dtype: torch.dtype, device: torch.device | None = None) -> Rendering:
    maps = {name: getattr(rendering, name) for name in MAPS}
    return Rendering(
        **{n: None if m is None else m.detach().to(device, dtype).requires_grad_() for n, m in maps.items()}
    )


def gradients(loss: Tensor, rendering: Rendering) -> dict[str, Tensor]:
    maps = {name: getattr(rendering, name) for name in MAPS if getattr(rendering, name) is not None}
    return dict(zip(maps, torch.autograd.grad(loss, list(maps.values()), materialize_grads=True), strict=True))


def check(rendering: Rendering, view: Photo, weights: LossSettings, progress: float, scale: float, device) -> Tensor:
    """Compare the loss, and the gradients of `scale` times the loss, with the float64 reference.

    Return the mean squared error of the picture.
    """
    exact, found = leaves(rendering, torch.float64), leaves(rendering, torch.float32, device)
    expected = sum(reference(exact, view, weights, progress).values())
    loss, square = objective(found, None, moved(view, device), BACKGROUND.to(device), weights, progress)
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    expected_gradients = gradients(scale * expected, exact)
    for name, gradient in gradients(scale * loss, found).items():
        worst = (gradient.cpu() - expected_gradients[name]).abs().max()
        assert worst <= 1e-4 * expected_gradients[name].abs().max(), name
    return square


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("material", [False, True])
@pytest.mark.parametrize("size", [(61, 40), (16, 16), (3, 5), (2, 2), (1, 1), (1, 30)])
def test_matches_float64(size, material, masked, device):
    rendering, view = pictures(*size, masked, material)
    square = check(rendering, view, ALL, 0.7, 3, device)
    check_square(square, rendering, view)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("white", [4080, 65535])
def test_16_bit_codes_match_float64(white, masked, device):
    rendering, view = pictures(61, 40, masked, material=True)
    view = with_16_bits(view, white)
    if white < 65535:
        rendering.color[::2] *= 20  # brighter than the largest code
    check_square(check(rendering, view, ALL, 0.7, 1, device), rendering, view)


def check_square(square: Tensor, rendering: Rendering, view: Photo) -> None:
    photo = view.image.double() / view.white
    if view.mask is not None:
        mask = view.mask.double()[..., None] / 255
        photo = photo * mask + BACKGROUND.double() * (1 - mask)
    error = ((rendering.color.clamp(0, 1) - photo.clamp(0, 1)) ** 2).mean()
    assert float(square) == pytest.approx(float(error), rel=1e-5)


def test_the_light_is_held_to_be_neutral_on_the_whole(device):
    """Check the loss term that keeps the environment's light neutral: its value and derivative match float64.

    The term grows as the light's mean colour departs from grey.
    """
    rendering, view = pictures(8, 8, masked=True, material=True)
    weights = only(light=0.5)
    mean = torch.rand(3, generator=torch.Generator().manual_seed(0))
    for scale in (1e-6, 1, 1e6):
        exact = (scale * mean).double().requires_grad_()
        expected = 0.5 * ((exact / exact.mean() - 1) ** 2).mean()
        light = exact.detach().float().to(device).requires_grad_()
        found = leaves(rendering, torch.float32, device)
        without = objective(found, None, moved(view, device), BACKGROUND.to(device), weights, 1.0).loss
        loss = objective(found, light, moved(view, device), BACKGROUND.to(device), weights, 1.0).loss
        assert float((loss - without).detach()) == pytest.approx(float(expected.detach()), rel=1e-4)
        loss.backward()
        torch.testing.assert_close(
            light.grad.cpu().double(), *torch.autograd.grad(expected, exact), rtol=1e-4, atol=1e-6 / scale
        )
    dark = torch.zeros(3, device=device, requires_grad=True)
    objective(found, dark, moved(view, device), BACKGROUND.to(device), weights, 1.0).loss.backward()
    assert not dark.grad.any()


@pytest.mark.parametrize("term", ["dssim", "normal", "smooth", "even", "alpha", "metallic", "matte"])
def test_a_term_without_weight_is_not_there(term, device):
    check(*pictures(30, 20, masked=True, material=True), ALL.model_copy(update={term: 0.0}), 1.0, 1, device)


def test_far_away_where_hardly_anything_is(device):
    """Check that depths of 1e11 at nearly transparent pixels do not change the loss and the gradients of other pixels."""
    rendering, view = pictures(30, 20, masked=True, material=True)
    rendering.alpha[::5, ::4], rendering.blended_depth[::5, ::4] = 0.01, 1e9
    check(rendering, view, ALL, 0.7, 1, device)


def test_nothing_waits_for_a_card(monkeypatch):
    """Check that computing the loss and its gradients reads no tensor's value, so the CPU never waits for the GPU."""
    emulate(monkeypatch)
    rendering, view = pictures(30, 20, masked=True, material=True)
    found = leaves(rendering, torch.float32)

    def refuse(*_: object) -> None:
        raise AssertionError("the host waits for the card")

    for name in ("__bool__", "__float__", "__int__", "cpu", "item", "numpy", "tolist"):
        monkeypatch.setattr(Tensor, name, refuse)
    loss, _ = objective(found, None, view, BACKGROUND, ALL, 0.7)
    loss.backward()


def test_other_photos_are_refused():
    rendering, view = pictures(30, 20, masked=True, material=True)
    said = "test: the photo and its mask must be uint8 on cpu, of the rendering's size"
    for other in {"image": view.image[:, 1:]}, {"mask": view.mask[:10]}, {"mask": view.mask.float()}:
        with pytest.raises(ValueError, match=said):
            objective(leaves(rendering, torch.float32), None, view._replace(**other), BACKGROUND, ALL, 1.0)


@pytest.mark.parametrize("term", [0.0, 0.2, 1.0], ids=["l1", "both", "dssim"])
@pytest.mark.parametrize(("code", "white"), [(255, 255), (65535, 65535), (65535, 4080)])
def test_a_clipped_photo_is_a_lower_bound(code, white, term, device):
    """Check that a clipped pixel pulls a darker rendering up, and a brighter one not at all, whatever the photo's exposure.

    A photo one code below the largest is not clipped and pulls from above, too.
    """
    weights = only(dssim=term)
    camera, bound = scenes.camera(16, 16), code / white
    dtype = torch.uint8 if white == 255 else torch.uint16

    def by_radiance(codes: int, factor: float, exposure: float) -> tuple[Tensor, Tensor]:
        radiance = torch.full((16, 16, 3), factor * srgb_decode(bound) / exposure, device=device, requires_grad=True)
        exposed = torch.tensor(exposure, device=device, requires_grad=True)
        texture = 1 + 0.05 * torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0)).to(device)
        one = torch.ones(16, 16, device=device)
        color = srgb_encode(radiance * texture * exposed)
        rendering = Rendering(color, one, one, torch.zeros(16, 16, 3, device=device))
        image = torch.full((16, 16, 3), codes, dtype=torch.int32).to(dtype).to(device)
        photo = Photo(image, torch.full((16, 16), 255, dtype=torch.uint8, device=device), camera, white=white)
        loss, _ = objective(rendering, None, photo, BACKGROUND.to(device), weights, 1.0)
        return torch.autograd.grad(loss, (radiance, exposed))

    for exposure in (1.0, 0.25, 3.0):
        assert not any(gradient.any() for gradient in by_radiance(code, 1.5, exposure))
        radiance, exposed = by_radiance(code, 0.5, exposure)
        assert radiance.sum() < 0 and exposed < 0
        if term < 1:
            radiance, exposed = by_radiance(code - 1, 1.5, exposure)
            assert radiance.sum() > 0 and exposed > 0


def test_the_background_is_no_lower_bound(device):
    """Check that a photo that is white where the mask is black pulls a bright rendering down, to the background."""
    rendering, view = pictures(8, 8, masked=True, material=False)
    rendering.color[:] = 1.5
    view.image[:], view.mask[:] = 255, 0
    weights = only()
    found = leaves(rendering, torch.float32, device)
    loss = objective(found, None, moved(view, device), torch.ones(3, device=device), weights, 1.0).loss
    assert (gradients(loss, found)["color"] > 0).all()


def test_normals_of_a_plane_agree_with_its_depth():
    camera = scenes.camera(40, 30)
    normal = np.array([0.2, -0.3, -0.9]) / np.linalg.norm([0.2, -0.3, -0.9])
    rays = scenes.camera_rays(camera).numpy().astype(float)
    depth = (-3 - normal @ camera.position) / (rays @ normal)
    one, view = torch.ones(30, 40), Photo(torch.zeros(30, 40, 3, dtype=torch.uint8), None, camera)
    flat = Rendering(
        torch.zeros(30, 40, 3), one, torch.tensor(depth).float(), torch.tensor(normal).float().expand(30, 40, 3)
    )
    weights = only(normal=1, smooth=1, even=1)
    assert abs(float(objective(flat, None, view, BACKGROUND, weights, 1.0).loss)) < 1e-6
    turned = replace(flat, normal=-flat.normal)
    assert float(objective(turned, None, view, BACKGROUND, weights, 1.0).loss) == pytest.approx(2, abs=1e-6)


def test_same_bits_for_any_number_of_threads():
    rendering, view = pictures(200, 150, masked=True, material=True)

    def all_of_it() -> list[Tensor]:
        maps = leaves(rendering, torch.float32)
        loss, _ = objective(maps, None, view, BACKGROUND, ALL, 1.0)
        return [loss.detach(), *gradients(loss, maps).values()]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)
