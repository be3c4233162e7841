"""Compare the program's Adam optimiser with torch's in float64. Both leave an element alone if its gradient is zero."""

import torch
from torch import Tensor

from refgs.model.adam import Adam
from tests.makers import scenes

SHAPES = [(1,), (1000, 3), (20_000,), (777, 4), (5, 2, 3)]
RATES = [1e-3, 0.0, 3e-2, 1e-4, 1.0]


def tensors(steps: int) -> tuple[list[Tensor], list[list[Tensor]]]:
    """Make start values, and gradients for each step. The sizes of gradients range from 1e-12 to 1e3.

    In one step all gradients of a tensor are zero. In another step one tensor has no gradient.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = [10.0 ** (15 * torch.rand(s, generator=generator) - 12) for s in SHAPES]
    values = [torch.randn(s, generator=generator) for s in SHAPES]
    gradients = [[size * torch.randn(size.shape, generator=generator) for size in sizes] for _ in range(steps)]
    gradients[0][2][:] = 0
    gradients[3][1] = None
    return values, gradients


def train(optimizer: torch.optim.Optimizer | Adam, values: list[Tensor], gradients: list[list[Tensor]]) -> None:
    for step in gradients:
        for value, gradient in zip(values, step, strict=True):
            value.grad = None if gradient is None else gradient.to(value)
        optimizer.step()


class Held(torch.optim.Adam):
    """Extend torch's Adam: an element whose gradient is zero keeps its value and its moments."""

    @torch.no_grad()
    def step(self) -> None:
        values = [v for group in self.param_groups for v in group["params"] if v.grad is not None]
        kept = [[x.clone() for x in (v, *self._moments(v))] for v in values]
        super().step()
        for value, before in zip(values, kept, strict=True):
            still = value.grad == 0
            for x, old in zip((value, *self._moments(value)), before, strict=True):
                x[still] = old[still]

    def _moments(self, value: Tensor) -> list[Tensor]:
        state = self.state[value]
        return [state[name] if name in state else torch.zeros_like(value) for name in ("exp_avg", "exp_avg_sq")]


def groups(values: list[Tensor]) -> list[dict]:
    return [{"params": [value], "lr": rate} for value, rate in zip(values, RATES, strict=True)]


def test_matches_float64(device):
    start, gradients = tensors(20)
    gradients[7][3][::3], gradients[11][2][100:5000] = 0, 0
    exact = [v.double().requires_grad_() for v in start]
    train(Held(groups(exact), eps=1e-15), exact, gradients)
    values = [v.to(device, copy=True).requires_grad_() for v in start]
    optimizer = Adam(groups(values))
    train(optimizer, values, gradients)
    for value, expected, begun, rate in zip(values, exact, start, RATES, strict=True):
        assert (value.cpu() - expected).abs().max() <= 2e-7 * begun.abs().max() * 20 + 1e-5 * rate
    assert [optimizer.state[v]["step"] for v in values] == [20, 19, 20, 20, 20]


def test_same_bits_for_any_number_of_threads():
    def all_of_it() -> list[Tensor]:
        start, gradients = tensors(5)
        values = [v.requires_grad_() for v in start]
        train(Adam(groups(values)), values, gradients)
        return [v.detach() for v in values]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)
