"""Compare the kernels' split-sum shading with Monte Carlo integration of the rendering equation."""

import itertools

import pytest

from tests.makers.rendering_equation import (
    ANGLES,
    DIELECTRIC,
    METAL,
    ROUGHNESS,
    Reflected,
    View,
    lights,
    monte_carlo,
    shaded,
    split_sum,
)


@pytest.fixture(scope="module")
def found() -> dict:
    """Shade all cases by the kernels; return radiance by light, angle, material and roughness."""
    cases, radiance = list(itertools.product((METAL, DIELECTRIC), ROUGHNESS)), {}
    for kind, angle in itertools.product(("constant", "gradient", "sun"), ANGLES):
        view = View.at(angle)
        pixels = shaded(lights(view.mirrored)[kind], view, [(roughness, material) for material, roughness in cases])
        for (material, roughness), value in zip(cases, pixels.tolist(), strict=True):
            radiance[kind, angle, material, roughness] = value
    return radiance


def truth(kind: str, angle: float, material, roughness: float, samples: int = 30_000) -> tuple[float, float]:
    view = View.at(angle)
    return monte_carlo(lights(view.mirrored)[kind], view.mirrored, view, roughness, material, samples)


@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
@pytest.mark.parametrize("kind", ["constant", "gradient", "sun"])
def test_the_truth_knows_its_error(kind, material):
    """Monte Carlo's standard error halves with four times the samples.

    Under a constant light, where radiance is known exactly, the true error is within four standard errors.
    """
    for angle, roughness in ((0, 0.1), (60, 0.4), (80, 1.0)):
        (_, coarse), (value, fine) = (truth(kind, angle, material, roughness, n) for n in (15_000, 60_000))
        assert coarse / fine == pytest.approx(2, rel=0.15)
        if kind == "constant":
            exact = Reflected.of(material, View.at(angle).way[2], roughness)
            assert abs(value - exact.specular - exact.base) < 4 * fine


def test_an_even_light_is_reflected_exactly(found):
    """Under a constant light, the relative error of radiance is below 0.001 at any roughness and angle."""
    for (kind, angle, material, roughness), radiance in found.items():
        if kind == "constant":
            exact = Reflected.of(material, View.at(angle).way[2], roughness)
            assert radiance == pytest.approx(exact.specular + exact.base, rel=1e-3)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
def test_a_gradient(found, material, angle):
    """Under a gradient light, the kernels are within 0.7 % of the exact split sum, for all texels, levels and harmonics.

    The split sum itself is within 1.5 % of the rendering equation up to a roughness of 0.2, and 2.5 % for a rougher dielectric. It is
    within 13 % for a rougher metal, whose lobe is partly below the horizon.
    """
    view = View.at(angle)
    for roughness in ROUGHNESS:
        radiance = found["gradient", angle, material, roughness]
        assert radiance == pytest.approx(
            split_sum(lights(view.mirrored)["gradient"], view, roughness, material), rel=7e-3
        )
        expected, error = truth("gradient", angle, material, roughness)
        bound = 0.015 if roughness <= 0.2 else 0.13 if material == METAL else 0.025
        assert abs(radiance - expected) < bound * expected + 3 * error


@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
def test_a_small_sun_seen_from_above(found, material):
    """Under a sun 4 degrees wide in the mirror direction, the kernels are within 31 % of the rendering equation.

    The exact split sum is within 2.5 % for narrow lobes and 20 % for wide ones. The rest comes from blending two roughness levels.
    """
    view = View.at(0)
    for roughness in ROUGHNESS:
        expected, error = truth("sun", 0, material, roughness)
        exact = split_sum(lights(view.mirrored)["sun"], view, roughness, material)
        assert abs(exact - expected) < (0.025 if roughness <= 0.2 else 0.2) * expected + 3 * error
        assert abs(found["sun", 0, material, roughness] - expected) < 0.31 * expected + 3 * error
