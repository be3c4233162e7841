import numpy as np
import pytest
import torch

from refgs.color import srgb_decode, srgb_encode


def test_known_values():
    # IEC 61966-2-1: both ends of the range, mid grey, and points in and at the end of the linear segment.
    linear = np.array([0.0, 0.002, 0.0031308, 0.214041140482, 1.0])
    np.testing.assert_allclose(srgb_encode(linear), [0.0, 0.02584, 0.0404499, 0.5, 1.0], atol=1e-6)


def test_decode_inverts_encode_beyond_the_display_too():
    linear = np.linspace(-0.5, 20, 5001)
    np.testing.assert_allclose(srgb_decode(srgb_encode(linear)), linear, atol=2e-5)


def test_torch_and_numpy_agree_and_keep_their_precision():
    values = np.linspace(-0.1, 3, 997, dtype=np.float32)
    for function in (srgb_encode, srgb_decode):
        ours = function(torch.from_numpy(values))
        assert ours.dtype == torch.float32 and function(values).dtype == np.float32
        np.testing.assert_allclose(ours.numpy(), function(values), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("function", [srgb_encode, srgb_decode])
def test_gradients_are_finite_and_right(function):
    values = torch.tensor([-2, -1e-9, 0, 1e-12, 0.001, 0.01, 0.3, 1, 30], dtype=torch.float64, requires_grad=True)
    function(values).sum().backward()
    with torch.no_grad():
        numeric = (function(values + 1e-6) - function(values - 1e-6)) / 2e-6
    torch.testing.assert_close(values.grad, numeric, rtol=1e-5, atol=1e-8)
