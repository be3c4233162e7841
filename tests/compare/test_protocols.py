"""Test the error measures of TensoIR and Stanford-ORB on pictures whose errors are known."""

import numpy as np
import pytest

from refgs.color import srgb_encode
from refgs.compare import protocols

HALF = np.zeros((32, 32))
HALF[8:24, 4:20] = 1
INSIDE = np.zeros((32, 32), bool)
INSIDE[10:22, 6:18] = True  # after the erosion


def patches(seed=0):
    """Return a linear picture (32, 32, 3) of values in 0.2..0.8."""
    return np.random.default_rng(seed).uniform(0.2, 0.8, (32, 32, 3))


def test_base_colour_is_corrected_by_the_median_ratio():
    true = [patches(i).reshape(-1, 3) for i in range(3)]
    rendered = [values * [0.5, 2.0, 1.0] for values in true]
    rendered[0][:300] = 5.0  # a minority that is wrong in another way
    assert protocols.albedo_ratio(list(zip(rendered, true, strict=True))) == pytest.approx([2.0, 0.5, 1.0])


def test_base_colour_is_compared_over_white():
    true = patches()
    assert protocols.albedo_square(true, true, HALF) == pytest.approx(0, abs=1e-12)
    wrong = np.where(HALF[..., None] > 0, true, 0.1)
    assert protocols.albedo_square(wrong, true, HALF) == pytest.approx(0, abs=1e-12), (
        "what lies beside the object is white"
    )
    square = protocols.albedo_square(np.full_like(true, 0.25), np.full_like(true, 0.5), HALF)
    assert square == pytest.approx((0.5 ** (1 / 2.2) - 0.25 ** (1 / 2.2)) ** 2 / 4), "a quarter of the picture"


def test_normals_beside_the_object_have_no_error_by_tensoir():
    true = np.zeros((32, 32, 3))
    true[..., 0] = 1
    turned = true @ np.array([[np.cos(0.2), np.sin(0.2), 0], [-np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    error = protocols.whole_normal_mae_degrees(turned, HALF, true, HALF)
    assert error == pytest.approx(np.degrees(0.2) / 4)


def test_equal_pictures_are_as_alike_as_can_be():
    photo = patches()
    found = protocols.similarity(photo, photo, HALF, False, False)
    assert found == pytest.approx({"psnr_h": 100, "psnr_l": 100, "ssim": 1})
    other = np.where(INSIDE[..., None], photo, 7.0)
    assert protocols.similarity(other, photo, HALF, False, False) == pytest.approx(found), (
        "the mask is eroded by 2 pixels"
    )


def test_a_tint_is_forgiven_only_where_pictures_are_scaled():
    photo = patches()
    tinted = photo * [0.5, 1.0, 2.0]
    assert protocols.similarity(tinted, photo, HALF, True, False)["psnr_h"] == pytest.approx(100)
    assert protocols.similarity(tinted, photo, HALF, False, False)["psnr_l"] < 25


def test_both_psnrs_of_even_pictures():
    """Compare a picture of 0.35 with one of 0.4, by hand: all that is not in the mask counts as equal."""
    image, photo = np.full((32, 32, 3), 0.35), np.full((32, 32, 3), 0.4)
    found, part = protocols.similarity(image, photo, HALF, False, False), INSIDE.mean()
    ldr = (srgb_encode(np.float64(0.4)) - srgb_encode(np.float64(0.35))) ** 2 * part
    assert found["psnr_l"] == pytest.approx(-10 * np.log10(ldr))
    factor = srgb_encode(np.float64(0.4)) / 0.4  # the picture's means are these times `part`
    assert found["psnr_h"] == pytest.approx(-10 * np.log10((0.05 * factor) ** 2 * part))


def test_no_picture_is_worse_than_grey():
    photo = np.full((32, 32, 3), 0.2)
    found = protocols.similarity(np.full((32, 32, 3), 3.0), photo, HALF, False, False)
    grey = (0.5 - srgb_encode(np.float64(0.2))) ** 2 * INSIDE.mean()
    assert found["psnr_l"] == pytest.approx(-10 * np.log10(grey))


def test_ssim_is_over_windows_of_three_pixels():
    image, photo = (srgb_encode(np.where(INSIDE[..., None], patches(i), 0)) for i in range(2))
    weights = np.exp(-np.array([1.0, 0, 1]) / (2 * 1.5**2))
    kernel = np.outer(weights, weights) / weights.sum() ** 2
    padded = [np.pad(x, ((1, 1), (1, 1), (0, 0)), mode="reflect") for x in (image, photo)]
    values = []
    for y, x in np.ndindex(32, 32):
        a, b = (p[y : y + 3, x : x + 3] for p in padded)
        ma, mb = ((kernel[..., None] * w).sum((0, 1)) for w in (a, b))
        va, vb = (kernel[..., None] * a * a).sum((0, 1)) - ma**2, (kernel[..., None] * b * b).sum((0, 1)) - mb**2
        cov = (kernel[..., None] * a * b).sum((0, 1)) - ma * mb
        values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    found = protocols.similarity(patches(0), patches(1), HALF, False, False)["ssim"]
    assert found == pytest.approx(np.mean(values)) and found < 0.99


def test_cosine_distance():
    true = np.zeros((32, 32, 3))
    true[..., 0] = 1
    normals = true * np.cos(0.3) + [0, np.sin(0.3), 0]
    normals[~INSIDE] = 0
    assert protocols.cosine_distance(normals, true, HALF) == pytest.approx(1 - np.cos(0.3), abs=1e-5)
    normals[:16] = 0  # a half is missing
    expected = (1 - np.cos(0.3) + 1) / 2
    assert protocols.cosine_distance(normals, true, HALF) == pytest.approx(expected, abs=1e-5)


def test_depth_has_one_scale_for_all_views():
    true = [2 + patches(i)[..., 0] for i in range(2)]
    assert protocols.depth_error([(3 * t, t, HALF) for t in true]) == pytest.approx(0, abs=1e-12)
    assert protocols.depth_error([(3 * true[0], true[0], HALF), (true[1], true[1], HALF)]) > 0.1
    assert protocols.depth_error([(0 * true[0], true[0], HALF)]) == pytest.approx((true[0] ** 2 * INSIDE).mean())
