"""The optimiser."""

import ctypes
import math
from collections import defaultdict

import torch
from torch import Tensor

from refgs.clock import timed
from refgs.kernels.load import Shared, Work, run

MOST = 16  # tensors


class _Learned(Work):
    """`struct Learned` of adam.cpp."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *((n, ctypes.c_void_p) for n in ("value", "mean", "square", "gradient")),
        *((n, ctypes.c_double) for n in ("rate", "square_scale", "low", "high")),
    )


class _Work(Work):
    """`struct Adam` of adam.cpp."""

    _fields_ = (
        ("tensors", ctypes.c_int64),
        ("learned", _Learned * MOST),
        *((n, ctypes.c_double) for n in ("beta1", "beta2", "epsilon")),
        ("accepted", ctypes.c_void_p),
        ("scratch", ctypes.c_void_p),
        ("shared", Shared),
    )


class Adam:
    """Adam (Kingma and Ba 2015), of float32 tensors on one device, all of them in one go: torch's own takes them one by one.

    A number whose gradient is zero, as of a surfel that the view does not see, is left as it is, with its moments: these
    neither fade nor move it on, as they would in Adam itself. So is a parameter without a gradient. A group's values are kept
    within its `limits`, a pair. Groups, whose `params` are lists, and state are as in `torch.optim.Adam` otherwise, the step a
    plain number. It is none of torch's own optimisers, whose first one loads torch's compiler: two seconds.
    """

    BETAS, EPSILON = (0.9, 0.999), 1e-15

    def __init__(self, groups: list[dict]):
        self.param_groups = [{"lr": 0.0, "limits": (-math.inf, math.inf)} | group for group in groups]
        self.state: dict[Tensor, dict] = defaultdict(dict)

    @timed("optimiser")
    @torch.no_grad()
    def step(self, accepted: Tensor | None = None) -> None:
        """Move every parameter by its group's rate `lr`; none, nor its moments, where `accepted`, a float32 scalar, is zero."""
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
