import sys
import types

import numpy as np
import pytest
import torch

from refgs.color import srgb_decode, srgb_encode
from refgs.compare import metrics
from refgs.formats.panorama import directions, sample

RANDOM = np.random.default_rng(7)


def test_psnr_of_a_known_error():
    reference = RANDOM.uniform(0.2, 0.8, (16, 20, 3))
    assert metrics.psnr(reference + 0.1, reference) == pytest.approx(20.0)
    assert metrics.psnr(reference, reference) == 100.0


def luminance(a, b):
    """Compute the luminance term of SSIM (Wang et al. 2004, Eq. 6 with K1 = 0.01)."""
    return (2 * a * b + 0.01**2) / (a * a + b * b + 0.01**2)


def test_ssim_of_flat_pictures_is_the_luminance_term():
    flat = np.ones((24, 24, 3))
    assert metrics.ssim(0.3 * flat, 0.6 * flat) == pytest.approx(luminance(0.3, 0.6), abs=1e-9)


def test_ssim_falls_with_noise():
    reference = RANDOM.uniform(0, 1, (32, 32, 3))
    noise = RANDOM.normal(size=reference.shape)
    values = [metrics.ssim(reference + amount * noise, reference) for amount in (0, 0.05, 0.2)]
    assert values[0] == pytest.approx(1) and values[0] > values[1] > values[2]


def unit_normals(shape):
    normals = RANDOM.normal(size=(*shape, 3))
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def test_normal_error_is_the_angle_whatever_the_length():
    reference = unit_normals((12, 10))
    side = np.cross(reference, RANDOM.normal(size=3))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    angle = np.radians(10)
    tilted = (np.cos(angle) * reference + np.sin(angle) * side) * RANDOM.uniform(0.1, 3, (12, 10, 1))
    ones = np.ones((12, 10))
    assert metrics.normal_mae_degrees(tilted, reference, ones, ones) == pytest.approx(10, abs=1e-6)


def test_missing_normals_count_as_ninety_degrees_and_the_background_not_at_all():
    reference, alpha = unit_normals((10, 10)), np.ones((10, 10))
    covered, rendered, normals = alpha.copy(), alpha.copy(), reference.copy()
    covered[5:] = 0.4  # background is ignored
    normals[5:] *= -1
    normals[0] = 0  # no normal
    rendered[1] = 0.05  # rendered almost transparent: counts as missing
    normals[2] = np.nan
    assert metrics.normal_mae_degrees(normals, reference, rendered, covered) == pytest.approx(90 * 3 / 5, abs=1e-5)


def test_flip_of_flat_greys_is_the_papers_colour_distance():
    picture = RANDOM.uniform(0, 1, (32, 40, 3))
    assert metrics.flip(picture, picture) == 0
    # Andersson et al. 2020, §4.1: flat pictures have no features, so FLIP compares colours only. The colour error is the lightness
    # difference to the power 0.7. It is divided by the largest error, 41.28, which is between green and blue. Shares above 0.4 are mapped
    # to 0.95 … 1.
    white, largest = np.ones((32, 32, 3)), 41.28
    expected = 0.95 + 0.05 * (100**0.7 - 0.4 * largest) / (0.6 * largest)
    assert metrics.flip(0 * white, white) == pytest.approx(expected, abs=1e-3)
    lightness = 116 * np.cbrt(srgb_decode(np.array([0.5, 0.55]))) - 16
    expected = 0.95 * abs(lightness[1] - lightness[0]) ** 0.7 / (0.4 * largest)
    assert metrics.flip(0.55 * white, 0.5 * white) == pytest.approx(expected, rel=0.02)


def test_lpips_says_why_it_is_missing_and_never_fetches_weights(tmp_path, monkeypatch):
    for name in ("lpips", "torchvision"):
        package = types.ModuleType(name)
        package.__spec__ = types.SimpleNamespace(name=name)
        monkeypatch.setitem(sys.modules, name, package)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert "vgg16-397923af.pth" in metrics.lpips_missing()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "vgg16-397923af.pth").touch()
    assert metrics.lpips_missing() is None
    monkeypatch.delitem(sys.modules, "lpips")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert metrics.lpips_missing() == "the package lpips is not installed"


def test_normal_ssim_is_of_encoded_normals_over_white():
    up = np.zeros((24, 24, 3))
    up[..., 2] = 1
    side, ones = up[..., [2, 0, 1]], np.ones((24, 24))
    assert metrics.normal_ssim(up, up, ones, ones) == pytest.approx(1)
    # (½, ½, 1) against (1, ½, ½) is flat: only the luminance term is left.
    expected = pytest.approx((2 * luminance(0.5, 1) + 1) / 3)
    assert metrics.normal_ssim(up, side, ones, ones) == expected
    # Uncovered pixels are white, whatever their normal is.
    assert metrics.normal_ssim(np.full_like(up, np.nan), up, 0 * ones, ones) == expected


def test_base_colours_are_aligned_by_one_scale_a_channel_for_all_views():
    truth, tint = RANDOM.uniform(0.1, 0.9, (2, 12, 10, 3)), np.array([0.5, 0.8, 1.1])
    mask = RANDOM.uniform(size=(12, 10)) > 0.4
    wrong = truth * tint
    wrong[:, ~mask] = 7  # background pixels, which must not count

    def aligned():
        return metrics.aligned_psnr([metrics.channel_products(a, b, mask) for a, b in zip(wrong, truth, strict=True)])

    result = aligned()
    assert result["psnr_aligned"] == pytest.approx(100, abs=1e-6)
    assert result["scale"] == pytest.approx(1 / tint)
    by_hand = [-10 * np.log10(((a - b)[mask] ** 2).mean()) for a, b in zip(wrong, truth, strict=True)]
    assert result["psnr_raw"] == pytest.approx(np.mean(by_hand))
    wrong[1] = truth[1] * 2 * tint  # the two views now need different scales
    assert aligned()["psnr_aligned"] < 30


def test_one_scale_for_all_views_is_found_and_a_sun_does_not_decide_it():
    truth = [np.dstack([RANDOM.uniform(0, 0.9, (20, 20, 3)), np.ones((20, 20))]) for _ in range(2)]
    images = [view * [0.5, 0.5, 0.5, 1] for view in truth]
    truth[0][3, 3, :3], images[0][3, 3, :3] = 4000.0, 3.0
    result = metrics.relit(lambda: zip(images, truth, strict=True))
    assert result["scale"] == pytest.approx(2)
    assert result["psnr_aligned"] == pytest.approx(100) and result["psnr_raw"] < 20
    assert result["flip_aligned"] == pytest.approx(0, abs=1e-6) and result["flip_raw"] > 0.1
    images[1][..., :3] *= 2
    assert metrics.relit(lambda: zip(images, truth, strict=True))["psnr_aligned"] < 30


def test_exposures_are_fitted_where_the_photo_tells():
    radiance, alpha = RANDOM.uniform(0, 1, (8, 9, 3)), np.ones((8, 9))
    factors = [1.5, 1.2, 0.9]
    photo = srgb_encode(factors * radiance)
    alpha[:2], photo[:2] = 0, 0.3
    assert (photo > 1).any()
    assert metrics.fitted_exposure(radiance, alpha, photo.clip(0, 1)) == pytest.approx(factors)
    assert (metrics.fitted_exposure(radiance, 0 * alpha, photo) == 1).all()


def test_uncovered_pixels_are_white_on_both_sides():
    pair = np.zeros((12, 12, 4)), np.tile([0.0, 0, 0, 1], (12, 12, 1))
    assert metrics.relit(lambda: [pair])["psnr_raw"] == pytest.approx(0)


def test_environment_error_ignores_scale_and_size_and_measures_the_log():
    light = np.exp(RANDOM.normal(size=(16, 32, 3)))
    error, scale = metrics.environment_log_rmse(np.repeat(np.repeat(light, 4, 0), 4, 1) * 0.25, light)
    assert error < 1e-5 and scale == pytest.approx(4, rel=1e-4)
    half = light.copy()
    half[:, :16] *= np.exp(0.2)  # half the sphere is off by 0.2 in the log: the best scale leaves ±0.1
    error, _ = metrics.environment_log_rmse(half, light)
    assert error == pytest.approx(0.1, rel=0.05)


def test_environment_pixels_count_by_solid_angle():
    light = np.ones((64, 128, 3))
    polar, equatorial = light.copy(), light.copy()
    polar[:4] *= 3
    equatorial[30:34] *= 3
    assert metrics.environment_log_rmse(polar, light)[0] < 0.4 * metrics.environment_log_rmse(equatorial, light)[0]


def lamps(turn=0.0, lift=0.0, height=64):
    """Make a panorama of a dim room with two lamps: the higher one is half as bright as the other.

    The lamps are turned about the vertical by `turn` degrees and raised by `lift` degrees.
    """
    rays = directions(height, 2 * height).astype(np.float64)
    light = np.full((height, 2 * height), 0.1)
    for azimuth, elevation, bright in ((40, 10, 20.0), (160, 35, 10.0)):
        a, e = np.radians(azimuth + turn), np.radians(elevation + lift)
        centre = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        light += bright * np.exp((rays @ centre - 1) / np.radians(4) ** 2)
    return np.repeat(light[..., None], 3, axis=2)


def test_lights_are_found_where_they_are():
    found, bright = metrics.find_lights(lamps())
    azimuth = np.degrees(np.arctan2(found[:2, 1], found[:2, 0]))
    np.testing.assert_allclose(azimuth, [40, 160], atol=0.1)
    np.testing.assert_allclose(np.degrees(np.arcsin(found[:2, 2])), [10, 35], atol=0.1)
    assert bright[0] == pytest.approx(2 * bright[1], rel=0.05)


def test_lights_error_is_the_angle_they_are_off_whatever_the_scale():
    truth = lamps()
    assert metrics.lights_error(3 * truth, truth) == (pytest.approx(0, abs=1e-3), 2)
    up, count = metrics.lights_error(lamps(lift=7), truth)
    assert up == pytest.approx(7, abs=0.1) and count == 2
    # Turning about the vertical moves the higher lamp by a smaller angle. The first lamp counts twice: it is twice as bright.
    moved = [2 * np.degrees(np.arcsin(np.sin(np.radians(5)) * np.cos(np.radians(e)))) for e in (10, 35)]
    assert metrics.lights_error(lamps(turn=10), truth)[0] == pytest.approx((2 * moved[0] + moved[1]) / 3, abs=0.1)
    # Compare two panoramas of different sizes, both turned by 180 degrees about the vertical.
    turned = sample(lamps(height=100), directions(100, 200) * np.float32([-1, -1, 1]))
    assert metrics.lights_error(turned, lamps(turn=180))[0] < 0.2


def test_a_light_that_was_not_found_counts_as_thirty_degrees_and_an_even_sky_has_none():
    truth = lamps()
    without = np.minimum(truth, lamps(turn=60))  # both lamps are removed
    assert metrics.lights_error(without, truth)[0] == pytest.approx(30)
    assert metrics.lights_error(truth, np.ones((32, 64, 3))) is None


def test_specks_are_single_wrong_pixels():
    truth = np.full((40, 50, 3), 0.5)
    truth[:, 25:] = 0.9  # an edge is none
    truth[10, 10] = 0.0  # nor is what the truth shows
    image = truth.copy()
    image[30, 10, 2] = 0.7
    image[20, 40] = 0.2
    image[11, 11] = 0.9  # beside what the truth shows
    image[5, 5] = 0.55  # too faint
    assert metrics.specks(image, truth) == pytest.approx(1e3 * 2 / (40 * 50))
    assert metrics.specks(truth, truth) == 0
    shifted = truth.copy()
    shifted[:, 25] = 0.5
    assert metrics.specks(shifted, truth) == 0
