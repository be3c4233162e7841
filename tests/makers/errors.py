"""Compare tensors with exact ones."""

from collections.abc import Iterable

from torch import Tensor


def check_near(names: Iterable[str], found: Iterable[Tensor], exact: Iterable[Tensor], most: float) -> None:
    """Check that each found tensor differs by at most `most` times the largest value of its exact tensor."""
    for name, value, expected in zip(names, found, exact, strict=True):
        error, size = (value.detach().cpu() - expected).abs().max(), expected.abs().max()
        assert error <= most * size, (name, float(error / size))
