"""Optimise parameters by Adam."""

import math
from collections import defaultdict

import torch
from torch import Tensor

from refgs.clock import timed
from refgs.kernels.layout import struct
from refgs.kernels.load import run

_Learned = struct("Learned", "adam.cpp")
_Work = struct("Adam", "adam.cpp")


class Adam:
    """Optimise float32 tensors on one device with Adam (Kingma and Ba 2015). One kernel updates all tensors.

    Elements whose gradient is zero keep their value and their moments. So a surfel that is not visible does not move. In the original Adam
    it would still move, because its moments decay slowly. Tensors without a gradient do not change either.

    The attributes `param_groups` and `state` are as in `torch.optim.Adam`, with three differences. A group may have `limits` (lowest,
    highest), to which its values are clamped. Its `params` must be a list. The "step" of the state is a Python number, not a tensor.

    The class does not derive from `torch.optim.Optimizer`, because creating the first optimiser imports torch's compiler, which takes two
    seconds.
    """

    BETAS, EPSILON = (0.9, 0.999), 1e-15

    def __init__(self, groups: list[dict]):
        self.param_groups = [{"lr": 0.0, "limits": (-math.inf, math.inf)} | group for group in groups]
        self.state: dict[Tensor, dict] = defaultdict(dict)

    @timed("optimiser")
    @torch.no_grad()
    def step(self, accepted: Tensor | None = None) -> None:
        """Update all parameters once, with the learning rate `lr` of their group.

        `accepted` is a float32 scalar on the tensors' device, or None. If it is zero, parameters and moments do not change.
        """
        (beta1, beta2), learned, kept = self.BETAS, [], []
        for group in self.param_groups:
            for value in group["params"]:
                if value.grad is None:
                    continue
                state = self.state[value]
                if not state:
                    state |= {"step": 0, "exp_avg": torch.zeros_like(value), "exp_avg_sq": torch.zeros_like(value)}
                state["step"] += 1
                t = state["step"]
                work = _Learned(count=value.numel(), rate=group["lr"] / (1 - beta1**t))
                work.square_scale, (work.low, work.high) = (1 - beta2**t) ** -0.5, group["limits"]
                gradient: Tensor = value.grad.contiguous()
                work.attach(value=value, mean=state["exp_avg"], square=state["exp_avg_sq"], gradient=gradient)
                learned.append(work)
                kept.append(gradient)
        if not learned:
            return
        work = _Work(tensors=len(learned))
        work.learned[: len(learned)] = learned
        work.beta1, work.beta2, work.epsilon = beta1, beta2, self.EPSILON
        if accepted is not None:
            work.attach(accepted=accepted)
        run("refgs_adam_step", work, kept[0], items=sum(gradient.numel() for gradient in kept))
