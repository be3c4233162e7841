"""Compare the program's Adam with torch's in float64. Both leave an element alone if its gradient is zero."""

import torch
from torch import Tensor

from refgs.model.learned import Learned
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


def train(optimizer: torch.optim.Optimizer | Learned, values: list[Tensor], gradients: list[list[Tensor]]) -> None:
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


def learned_of(values: list[Tensor]) -> Learned:
    learned = Learned()
    for number, (value, rate) in enumerate(zip(values, RATES, strict=True)):
        learned.learn(str(number), value)
        learned.rates[str(number)] = rate
    return learned


def test_matches_float64(device):
    start, gradients = tensors(20)
    gradients[7][3][::3], gradients[11][2][100:5000] = 0, 0
    exact = [v.double().requires_grad_() for v in start]
    groups = [{"params": [value], "lr": rate} for value, rate in zip(exact, RATES, strict=True)]
    train(Held(groups, eps=1e-15), exact, gradients)
    learned = learned_of([v.to(device, copy=True) for v in start])
    values = [*learned.values()]
    train(learned, values, gradients)
    for value, expected, begun, rate in zip(values, exact, start, RATES, strict=True):
        assert (value.cpu() - expected).abs().max() <= 2e-7 * begun.abs().max() * 20 + 1e-5 * rate
    assert [moments.steps for moments in learned.moments.values()] == [20, 19, 20, 20, 20]


def test_same_bits_for_any_number_of_threads():
    def all_of_it() -> list[Tensor]:
        start, gradients = tensors(5)
        learned = learned_of(start)
        train(learned, [*learned.values()], gradients)
        return [v.detach() for v in learned.values()]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)
