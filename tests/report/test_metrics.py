import numpy as np
import OpenEXR
import pytest

from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.report import metrics

RANDOM = np.random.default_rng(7)


def test_psnr_of_a_known_error():
    reference = RANDOM.uniform(0.2, 0.8, (16, 20, 3))
    assert metrics.psnr(reference + 0.1, reference) == pytest.approx(20.0)
    mask = np.zeros((16, 20), bool)
    mask[:4] = True
    image = reference.copy()
    image[:4] += 0.01
    image[4:] += 0.3
    assert metrics.psnr(image, reference, mask) == pytest.approx(40.0)
    assert metrics.psnr(reference, reference) == 100.0


def test_ssim_of_flat_pictures_is_the_luminance_term():
    a, b = 0.3, 0.6
    flat = np.ones((24, 24, 3))
    expected = (2 * a * b + 0.01**2) / (a * a + b * b + 0.01**2)  # Wang et al. 2004, Eq. 6 with K1 = 0.01
    assert metrics.ssim(a * flat, b * flat) == pytest.approx(expected, abs=1e-9)


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
    covered = alpha.copy()
    covered[5:] = 0.4  # background: whatever is there is not looked at
    normals = reference.copy()
    normals[5:] *= -1
    normals[0] = 0  # no normal
    rendered = alpha.copy()
    rendered[1] = 0.05  # next to nothing rendered
    normals[2] = np.nan
    assert metrics.normal_mae_degrees(normals, reference, rendered, covered) == pytest.approx(90 * 3 / 5, abs=1e-5)


def test_one_scale_is_found_and_a_sun_does_not_decide_it():
    reference = np.dstack([RANDOM.uniform(0, 0.9, (20, 20, 3)), np.ones((20, 20))])
    image = reference.copy()
    image[..., :3] *= 0.5
    reference[3, 3, :3] = 4000.0
    image[3, 3, :3] = 3.0
    raw, aligned, scale = metrics.scale_aligned_psnr(image, reference)
    assert scale == pytest.approx(2)
    assert aligned == pytest.approx(100) and raw < 20


def test_an_exposure_is_fitted_where_the_photo_tells():
    radiance, alpha = RANDOM.uniform(0, 1, (8, 9, 3)), np.ones((8, 9))
    alpha[:2] = 0
    photo = srgb_encode(1.5 * radiance)
    photo[:2] = 0.3
    assert (photo > 1).any()
    assert metrics.fitted_exposure(radiance, alpha, photo.clip(0, 1)) == pytest.approx(1.5)
    assert metrics.fitted_exposure(radiance, 0 * alpha, photo) == 1


def test_uncovered_pixels_are_white_on_both_sides():
    empty = np.zeros((8, 8, 4))
    black = empty.copy()
    black[..., 3] = 1
    assert metrics.scale_aligned_psnr(empty, black)[0] == pytest.approx(0)


def test_environment_error_ignores_scale_and_size_and_measures_the_log():
    light = np.exp(RANDOM.normal(size=(16, 32, 3)))
    error, scale = metrics.environment_log_rmse(np.repeat(np.repeat(light, 4, 0), 4, 1) * 0.25, light)
    assert error < 1e-5 and scale == pytest.approx(4, rel=1e-4)
    half = light.copy()
    half[:, :16] *= np.exp(0.2)  # half the sphere by 0.2 in the log: ±0.1 once the scale is out
    error, _ = metrics.environment_log_rmse(half, light)
    assert error == pytest.approx(0.1, rel=0.05)


def test_environment_pixels_count_by_solid_angle():
    light = np.ones((64, 128, 3))
    polar, equatorial = light.copy(), light.copy()
    polar[:4] *= 3
    equatorial[30:34] *= 3
    assert metrics.environment_log_rmse(polar, light)[0] < 0.4 * metrics.environment_log_rmse(equatorial, light)[0]


def write(path, pixels):
    OpenEXR.File({}, {"RGBA"[: pixels.shape[2]]: pixels.astype(np.float32)}).write(str(path))
    return path


def test_relit_files_are_compared(tmp_path):
    truth = np.dstack([RANDOM.uniform(0, 0.9, (20, 20, 3)), np.ones((20, 20))])
    half = truth * [0.5, 0.5, 0.5, 1]
    result = metrics.compare_relight(write(tmp_path / "a.exr", half), write(tmp_path / "b.exr", truth))
    assert result["scale"] == pytest.approx(2, rel=1e-4) and result["psnr_aligned"] > 90 > 30 > result["psnr_raw"]


def test_relit_files_that_do_not_fit_are_refused(tmp_path):
    truth = write(tmp_path / "truth.exr", np.ones((20, 20, 4)))
    with pytest.raises(InputError, match="not the same size"):
        metrics.compare_relight(write(tmp_path / "small.exr", np.ones((10, 20, 4))), truth)
    with pytest.raises(InputError, match="no alpha"):
        metrics.compare_relight(write(tmp_path / "opaque.exr", np.ones((20, 20, 3))), truth)
