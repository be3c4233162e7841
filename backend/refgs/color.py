"""Apply the sRGB transfer curve to numpy arrays and torch tensors. Convert between the primaries of colour spaces."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", np.ndarray, "Tensor")

# Chromaticities x, y of Rec.709 / sRGB: red, green, blue, D65 white (ITU-R BT.709-6, table 1).
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_D50 = np.array([0.9642, 1.0, 0.8249])  # XYZ (ICC.1:2022, 7.2.16)
# From XYZ to the cones' responses by which Bradford's method adapts to another white (ICC.1:2022, annex E.3).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

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


def primaries_to_rec709(chromaticities: Sequence[float]) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB of other primaries to linear Rec.709. White stays white (Bradford's adaptation).

    `chromaticities` are x and y of red, green, blue and white. Raises ValueError if there is no finite matrix, as when the primaries lie on
    one line.
    """
    with np.errstate(all="ignore"):
        matrix = pcs_to_rec709() @ _to_pcs(chromaticities)
    if not np.isfinite(matrix).all():
        raise ValueError("the primaries span no colours")
    return matrix


def pcs_to_rec709() -> np.ndarray:
    """Return the matrix (3, 3) from ICC profiles' XYZ (D50) to linear Rec.709."""
    return np.linalg.inv(_to_pcs(REC709))


def _to_pcs(chromaticities: Sequence[float]) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB to XYZ adapted to D50."""
    x, y = np.reshape(np.asarray(chromaticities, np.float64), (4, 2)).T
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])  # red, green, blue, white, each of luminance 1
    primaries, white = xyz[:, :3], xyz[:, 3]
    to_xyz = primaries * np.linalg.solve(primaries, white)
    gains = (_BRADFORD @ _D50) / (_BRADFORD @ white)
    return np.linalg.inv(_BRADFORD) @ (gains[:, None] * _BRADFORD) @ to_xyz
