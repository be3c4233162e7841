"""Compare the kernels' split-sum shading with Monte Carlo integration of the rendering equation."""

import itertools

import pytest

from tests.makers.rendering_equation import ANGLES, DIELECTRIC, METAL, ROUGHNESS, even, monte_carlo, shaded, split_sum


@pytest.fixture(scope="module")
def found() -> dict:
    """Shade all cases by the kernels. Return a mapping from (light, angle, roughness, material) to radiance."""
    cases, radiance = list(itertools.product(ROUGHNESS, (METAL, DIELECTRIC))), {}
    for kind, angle in itertools.product(("constant", "gradient", "sun"), ANGLES):
        for case, value in zip(cases, shaded(kind, angle, cases).tolist(), strict=True):
            radiance[kind, angle, *case] = value
    return radiance


@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
@pytest.mark.parametrize("kind", ["constant", "gradient", "sun"])
def test_the_truth_knows_its_error(kind, material):
    """Check the Monte Carlo reference: its standard error halves with four times the samples.

    Under a constant light the exact radiance is known. There, the true error is within four standard errors.
    """
    for angle, roughness in ((0, 0.1), (60, 0.4), (80, 1.0)):
        (_, coarse), (value, fine) = (monte_carlo(kind, angle, roughness, material, n) for n in (15_000, 60_000))
        assert coarse / fine == pytest.approx(2, rel=0.15)
        if kind == "constant":
            assert abs(value - even(angle, roughness, material)) < 4 * fine


def test_an_even_light_is_reflected_exactly(found):
    """Check that under a constant light the error of radiance is below 0.1 %, at any roughness and angle."""
    for (kind, *case), radiance in found.items():
        if kind == "constant":
            assert radiance == pytest.approx(even(*case), rel=1e-3), case


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
def test_a_gradient(found, material, angle):
    """Check shading under a light that varies linearly over the sky: within 0.7 % of the exact split sum.

    Against the rendering equation, the error is within 1.5 % up to a roughness of 0.2. At higher roughness it is within 2.5 % for a
    dielectric, and within 13 % for a metal, whose lobe is partly below the horizon.
    """
    for roughness in ROUGHNESS:
        case = "gradient", angle, roughness, material
        assert found[case] == pytest.approx(split_sum(*case), rel=7e-3)
        expected, error = monte_carlo(*case)
        bound = 0.015 if roughness <= 0.2 else 0.13 if material == METAL else 0.025
        assert abs(found[case] - expected) < bound * expected + 3 * error


@pytest.mark.parametrize("material", [METAL, DIELECTRIC])
def test_a_small_sun_seen_from_above(found, material):
    """Check shading under a small sun in the mirror direction: within 31 % of the rendering equation.

    The sun's radiance falls off as a lobe with a standard deviation of 4 degrees. The exact split sum is within 2.5 % up to a roughness of
    0.2, and within 20 % above. The rest of the error comes from blending two roughness levels.
    """
    for roughness in ROUGHNESS:
        case = "sun", 0, roughness, material
        expected, error = monte_carlo(*case)
        assert abs(split_sum(*case) - expected) < (0.025 if roughness <= 0.2 else 0.2) * expected + 3 * error
        assert abs(found[case] - expected) < 0.31 * expected + 3 * error
