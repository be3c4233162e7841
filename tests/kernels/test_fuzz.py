"""Test the kernels on random input (by hypothesis) against float64, over the ranges in docs/stability.md."""

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from benchmarks.stability import compare
from benchmarks.stability.geometry import camera, surfels
from benchmarks.stability.material import lit, rays, steps
from refgs.model.surfels import activate
from refgs.render import reference
from refgs.render.rasterize import rasterize
from refgs.render.ssim import dssim

SETTINGS = {"deadline": None, "derandomize": True, "suppress_health_check": [HealthCheck.function_scoped_fixture]}
FUZZ = settings(max_examples=40, **SETTINGS)
FEW = settings(max_examples=12, **SETTINGS)
EMULATED = settings(max_examples=4, **SETTINGS)
MOST = 1e-5


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10**exponent)


def check(found, most: float = MOST) -> None:
    assert found.finite and found.error <= most, found


SCENES = {
    "focal": powers(-2, 4),
    "pixels": powers(-5, 3),
    "aspect": powers(0, 6),
    "edge_on": st.one_of(st.none(), powers(-9, -1)),
    "least": st.floats(0, 1),
    "depth": powers(-0.5, 2),
    "centre": st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
}


def drawn(focal, pixels, aspect, edge_on, least, depth, centre) -> None:
    view = camera(focal, centre, (19, 13))
    how = {"pixels": (pixels, 10 * pixels), "aspect": aspect, "edge_on": edge_on, "opacity": (least, 1.0)}
    try:
        check(compare.raster(surfels(view, 25, depth=(0.5 * depth, 2 * depth), **how), view, near=0.1 / max(focal, 1)))
    except compare.Undecided:
        assume(False)


@FUZZ
@given(**SCENES)
def test_rasteriser(**scene):
    drawn(**scene)


@pytest.mark.parametrize("card", ["emulated"], indirect=True)
@EMULATED
@given(**SCENES)
def test_rasteriser_of_cards(card, **scene):
    drawn(**scene)


ANYTHING = st.floats(allow_nan=False, width=32)


@FUZZ
@given(st.lists(st.tuples(*[ANYTHING] * 9), min_size=1, max_size=6), st.floats(0, 1, width=32))
def test_rasteriser_takes_any_number(rows, opacity):
    """Check that the rasteriser's maps are finite for all float32 input except NaN, even for infinite and denormal numbers.

    Each of `rows` holds a surfel's position, rotation and scale.
    """
    rows = torch.tensor(rows)
    position, rotation, scale = (v.contiguous().requires_grad_() for v in rows.split((3, 4, 2), dim=1))
    opacities = torch.full((len(rows),), opacity).requires_grad_()
    features = torch.ones(len(rows), 2, requires_grad=True)
    maps = rasterize(position, rotation, scale.abs(), opacities, features, camera(size=(9, 7)), near=0.1)
    assert all(m.isfinite().all() for m in maps)
    assert float(maps.alpha.detach().max()) <= 1 + 1e-5


MATERIALS = {
    "metallic": st.one_of(st.none(), st.sampled_from([0.0, 1.0])),
    "roughness": st.one_of(st.none(), st.floats(0.01, 0.07), st.floats(0.66, 0.99)),
    "albedo": st.one_of(st.none(), st.floats(0, 1)),
    "grazing": st.one_of(st.none(), powers(-7, -0.5)),
    # The sun's radiance, and a factor for all radiance.
    "light": st.one_of(st.tuples(st.just(0.0), powers(-12, 3)), st.tuples(powers(0, 6), st.just(1.0))),
}


def shaded(light, **how) -> None:
    how |= {"sun": light[0], "scale": light[1]}
    # Cubemap look-ups round by 1e-6 of a texel. Beside a sun of radiance 1e6 this error is as large as the sky's radiance: 3e-3 in sRGB.
    # It is larger still, relative to the result, for a black metal, which reflects little.
    most = 3e-5 if light[0] == 0 else 3e-2
    try:
        check(lit(**how), most)
    except compare.Undecided:
        check(lit(**how, kink=True), most)


@FUZZ
@given(**MATERIALS)
def test_shading(**how):
    shaded(**how)


@pytest.mark.parametrize("card", ["emulated"], indirect=True)
@EMULATED
@given(**MATERIALS)
def test_shading_of_cards(card, **how):
    shaded(**how)


@FEW
@given(powers(-12, 15))
def test_optimiser(size):
    check(steps(size))


@FEW
@given(powers(-6, 6), st.floats(-1e5, 1e5))
def test_rays(scale, offset):
    assert rays(scale, offset * min(scale, 1)).error < 0.01


SSIM_C2 = 9e-4


@FUZZ
@example(1.0, 1.0, 1e-5, 0)  # nearly constant images
@given(st.floats(0, 1), st.floats(0, 1), powers(-6, 0), st.integers(0, 9))
def test_dssim(one, other, spread, seed):
    generator = torch.Generator().manual_seed(seed)
    image, target = (v + spread * torch.rand(12, 15, 3, generator=generator) for v in (one, other))
    exact = image.double().requires_grad_()
    expected = reference.dssim(exact, target.double())
    (exact_by,) = torch.autograd.grad(expected, exact)
    found, by = dssim(image, target)
    assert abs(float(found) - float(expected.detach())) < 1e-4  # variances cancel: they are differences of squares
    # Rounding of the same cancelling terms, in the derivative of a mean.
    rounding = 4 * torch.finfo(torch.float32).eps / (SSIM_C2 * image.numel())
    assert float((by - exact_by).abs().max()) < 2e-2 * float(exact_by.abs().max()) + rounding


# NaN as a CUDA card writes it; a CPU's NaN has zeros in its low bits.
CARDS_NAN = float(np.uint32(0x7FFFFFFF).view(np.float32))


@FUZZ
@example([CARDS_NAN] * 20)
@given(st.lists(st.floats(width=32), min_size=1, max_size=20))
def test_activations(numbers):
    """Check the functions that turn raw parameters into scales, opacities and materials: they are finite and monotonic.

    NaN gives NaN. No other number does.
    """
    raw = torch.tensor(sorted(numbers, key=lambda x: (math.isnan(x), x)))
    rest = ("position", "rotation", "sh_dc", "sh_rest", "received", "indirect_dc", "indirect_rest")
    learned = ("scale", "opacity", "albedo", "metallic", "roughness")
    values, known = activate(dict.fromkeys(rest, torch.zeros(len(raw), 1)) | dict.fromkeys(learned, raw)), ~raw.isnan()
    for value in (values.scales, values.opacities, values.albedo, values.metallic, values.roughness):
        assert torch.equal(value.isnan(), ~known)
        assert value[known].isfinite().all() and (value[known].diff() >= -1e-6 * value[known][1:]).all()
