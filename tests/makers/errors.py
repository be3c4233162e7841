"""Check tensors against exact values."""

from collections.abc import Iterable

from torch import Tensor


def check_near(names: Iterable[str], found: Iterable[Tensor], exact: Iterable[Tensor], tolerance: float) -> None:
    """Check tensors against exact ones: no error may be larger than `tolerance` times the largest exact value.

    Each tensor has its own exact tensor, and a name for the message.
    """
    for name, value, expected in zip(names, found, exact, strict=True):
        error, size = (value.detach().cpu() - expected).abs().max(), expected.abs().max()
        assert error <= tolerance * size, (name, float(error / size))
