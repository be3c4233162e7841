"""Apply the sRGB transfer curve to numpy arrays and torch tensors."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", np.ndarray, "Tensor")

_LINEAR_END = 0.0031308  # linear radiance where the straight piece of the curve ends
_ENCODED_END = 0.04045  # the same point, encoded


def srgb_encode(linear: Values) -> Values:
    """Encode linear Rec.709 radiance as sRGB (IEC 61966-2-1), element by element.

    Values are not clamped: the straight piece extends below zero and the power law above one. So values and gradients are
    finite for every finite input. Clamp to 0..1 where a display or an 8-bit file needs it.
    """
    where, maximum = _functions(linear)
    # Clamp before the power: at and below zero its gradient is infinite or NaN, and where() does not mask a NaN gradient.
    curve = 1.055 * maximum(linear, _LINEAR_END) ** (1 / 2.4) - 0.055
    return where(linear <= _LINEAR_END, 12.92 * linear, curve)


def srgb_decode(encoded: Values) -> Values:
    """Decode sRGB values (0..1 in a photo) to linear Rec.709 radiance: the inverse of `srgb_encode`."""
    where, maximum = _functions(encoded)
    curve = ((maximum(encoded, _ENCODED_END) + 0.055) / 1.055) ** 2.4
    return where(encoded <= _ENCODED_END, encoded / 12.92, curve)


def _functions(values: Values) -> tuple[Callable[..., Any], Callable[..., Any]]:
    if isinstance(values, np.ndarray | np.number | float | int):
        return np.where, np.maximum
    import torch  # here, because most users of numpy arrays never need torch

    return torch.where, lambda x, low: x.clamp(min=low)
