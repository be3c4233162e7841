"""Compare the D-SSIM kernel with plain torch in float64."""

import pytest
import torch

from refgs.render import reference
from refgs.render.ssim import dssim
from tests.makers import scenes


def compared(image, target, device, weight=1.0):
    """Compute D-SSIM on a device and in float64. Return both values, and the error of the gradient.

    The error is relative to the largest derivative.
    """
    exact = image.double().requires_grad_()
    expected = reference.dssim(exact, target.double())
    (exact_by,) = torch.autograd.grad(weight * expected, exact)
    found, by = dssim(image.to(device), target.to(device), weight)
    assert found.dtype == torch.float32 and found.shape == ()
    return found.item(), expected.item(), (by.cpu() - exact_by).abs().max() / exact_by.abs().max()


@pytest.mark.parametrize("shape", [(40, 57), (64, 16), (3, 4), (1, 1), (11, 200)])
@pytest.mark.parametrize("likeness", [0.0, 0.5, 0.98])
def test_matches_float64(shape, likeness, device):
    torch.manual_seed(0)
    target = torch.rand(*shape, 3)
    image = likeness * target + (1 - likeness) * torch.rand(*shape, 3)
    found, expected, error_by = compared(image, target, device, 3)
    assert abs(found - expected) <= 1e-5 * max(expected, 0.1) and error_by <= 1e-4


def test_flat_images(device):
    """Check D-SSIM of images of a single colour: it is within 1e-4 of float64, its gradient within 0.5 %.

    The tolerance is large because the variance is a difference of nearly equal squares, for which float32 has few digits.
    """
    found, expected, error_by = compared(torch.full((30, 30, 3), 0.9), torch.full((30, 30, 3), 0.8), device)
    assert abs(found - expected) < 1e-4 and error_by <= 5e-3


def test_same_image(device):
    image = torch.rand(20, 20, 3, device=device)
    assert abs(float(dssim(image, image)[0])) < 1e-6


def test_same_bits_for_any_number_of_threads():
    torch.manual_seed(0)
    image, target = torch.linspace(0, 1, 6000).reshape(50, 40, 3), torch.rand(50, 40, 3)
    scenes.check_same_bits_for_any_number_of_threads(lambda: list(dssim(image, target)))


def test_wrong_images_are_refused():
    for image, target in [((8, 8, 3), (8, 9, 3)), ((8, 8), (8, 8)), ((8, 8, 4), (8, 8, 4)), ((0, 8, 3), (0, 8, 3))]:
        with pytest.raises(ValueError, match="expected"):
            dssim(torch.rand(image), torch.rand(target))
