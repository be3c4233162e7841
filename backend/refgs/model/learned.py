"""Hold the tensors that a training learns, and let Adam learn them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refgs.clock import timed
from refgs.kernels.layout import struct
from refgs.kernels.load import run

LOGIT = 12.0  # beyond, a logistic function is within 1e-5 of its limit, and its slope is too small to learn by
LIMITS = {
    "opacity": (-LOGIT, LOGIT),
    "albedo": (-LOGIT, LOGIT),
    "roughness": (-LOGIT, LOGIT),
    "metallic": (-LOGIT / 2, LOGIT / 2),  # its activation approaches its limits as the square of a logistic function
    "exposure": (-LOGIT, LOGIT),  # natural logarithm of a factor: 12 is 17 stops
}
DARKEST = -LOGIT  # raw light, a logarithm; photos tell no darker light apart
SMALLEST, LARGEST = 1e-6, 1e2  # a surfel's scale, in scene radii

_Tensor = struct("Learned", "adam.cpp")
_Work = struct("Adam", "adam.cpp")


@dataclass
class Moments:
    """Hold Adam's moments after `steps` steps: running means of the gradient and its `square`."""

    steps: int
    mean: Tensor
    square: Tensor


class Learned(Mapping[str, Tensor]):
    """Hold the tensors that a training learns, by name, with Adam's moments, learning rates and limits.

    A tensor that has one row for each surfel is called "by row". The light's texels are not. The rows of all tensors by row are replaced
    together (see `rows`). This includes tensors that get no gradient, such as masks, which Adam does not change. `constant` holds the
    tensors by row that no longer learn, each with one row that all surfels share.

    One kernel updates all tensors with Adam (Kingma and Ba 2015). Elements whose gradient is zero keep their value and their moments. So a
    surfel that is not visible does not move. In the original Adam it would still move, because its moments decay slowly.
    """

    BETAS, EPSILON = (0.9, 0.999), 1e-15

    def __init__(self, radius: float = 1.0, brightest: float = math.inf) -> None:
        """Start without tensors; `limits` uses `radius` (world units) and `brightest` (raw light)."""
        self.rates: dict[str, float] = {}
        self.moments: dict[str, Moments] = {}  # of the tensors that Adam has updated
        self.constant: dict[str, Tensor] = {}
        self._radius, self._brightest = radius, brightest
        self._values: dict[str, Tensor] = {}
        self._by_row: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    @property
    def by_row(self) -> dict[str, Tensor]:
        """Return the tensors that have a row for each surfel, by name."""
        return {name: value for name, value in self._values.items() if name in self._by_row}

    @property
    def count(self) -> int:
        """Return the number of surfels."""
        return len(self._values["position"])

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value, before activation, that a tensor's elements may take."""
        if name == "scale":
            return math.log(SMALLEST * self._radius), math.log(LARGEST * self._radius)
        if name == "environment":
            return DARKEST, self._brightest
        return LIMITS.get(name, (-math.inf, math.inf))

    def learn(self, name: str, value: Tensor, by_row: bool = True) -> None:
        """Start to learn a tensor from the values in `value`, without moments.

        `by_row` says that it has one row for each surfel. If a tensor with this name exists, it is replaced, and its learning rate stays.
        The learning rate of a new tensor is 0.
        """
        self._values[name] = _leaf(value)
        self.moments.pop(name, None)
        self.constant.pop(name, None)
        self.rates.setdefault(name, 0.0)
        if by_row:
            self._by_row.add(name)

    def drop(self, *names: str) -> None:
        """Stop learning tensors: those by row keep the first surfel's value, others are removed."""
        for name in {*names} & {*self._values}:
            value = self._values.pop(name)
            self.moments.pop(name, None)
            del self.rates[name]
            if name in self._by_row:
                self._by_row.remove(name)
                self.constant[name] = value.detach()[:1].clone()

    @torch.no_grad()
    def rows(self, index: Tensor, fresh: Sequence[Tensor] = ()) -> None:
        """Replace all surfels: new surfel i is a copy of old surfel `index`[i]. An index may occur more than once.

        Moments are copied, too, but new surfels whose indices are in `fresh` start with zero moments. Adam then moves these surfels faster
        at first. This makes pictures worse for a while, but the final result is better for captures without masks. If memory runs out, all
        surfels stay as they were.
        """
        values = {name: _leaf(value.detach()[index]) for name, value in self.by_row.items()}
        moments = {}
        for name in values.keys() & self.moments.keys():
            old = self.moments[name]
            moments[name] = Moments(old.steps, old.mean[index], old.square[index])
            for which in fresh:
                moments[name].mean[which] = moments[name].square[which] = 0
        self._values |= values
        self.moments |= moments

    def columns(self, name: str, count: int) -> None:
        """Keep only the first `count` columns of a tensor and of its moments."""
        self._values[name] = _leaf(self._values[name].detach()[:, :count].contiguous())
        if old := self.moments.get(name):
            mean, square = (moment[:, :count].contiguous() for moment in (old.mean, old.square))
            self.moments[name] = Moments(old.steps, mean, square)

    @torch.no_grad()
    def fill(self, name: str, value: Tensor | float) -> None:
        """Set a tensor to a number or a broadcastable tensor, and forget its moments."""
        self._values[name][:] = value
        self.forget(name)

    def forget(self, name: str, which: Tensor | None = None) -> None:
        """Zero a tensor's moments where `which` (N,) is true; None forgets them all."""
        if which is None:
            self.moments.pop(name, None)
        elif old := self.moments.get(name):
            old.mean[which] = old.square[which] = 0

    def has_learned(self, name: str) -> bool:
        """Tell whether Adam has updated a tensor since `learn` or `fill` set it."""
        return name in self.moments

    def gradients(self) -> list[Tensor]:
        """Return the gradients that the last backward pass has computed."""
        return [value.grad for value in self._values.values() if value.grad is not None]

    def forget_gradients(self) -> None:
        """Drop the gradients of the last backward pass."""
        for value in self._values.values():
            value.grad = None

    @timed("optimiser")
    @torch.no_grad()
    def step(self, accepted: Tensor | None = None) -> None:
        """Take one step of Adam with all tensors that have a gradient, at their learning rates. Values are clamped to `limits`.

        `accepted` is a float32 scalar on the tensors' device, or None. If it is zero, values and moments do not change.
        """
        (beta1, beta2), learned, kept = self.BETAS, [], []
        for name, value in self._values.items():
            if value.grad is None:
                continue
            moments = self.moments.get(name)
            if moments is None:
                moments = self.moments[name] = Moments(0, torch.zeros_like(value), torch.zeros_like(value))
            moments.steps += 1
            work = _Tensor(count=value.numel(), rate=self.rates[name] / (1 - beta1**moments.steps))
            work.square_scale, (work.low, work.high) = (1 - beta2**moments.steps) ** -0.5, self.limits(name)
            gradient = value.grad.contiguous()
            work.attach(value=value, mean=moments.mean, square=moments.square, gradient=gradient)
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

    def save(self) -> dict[str, Tensor]:
        """Return all tensors and moments by the names under which `load` expects them."""
        tensors = {self._kept(name): value for name, value in self._values.items()}
        tensors |= {f"constant.{name}": value for name, value in self.constant.items()}
        for name, moments in self.moments.items():
            tensors |= {f"adam.{name}.step": torch.tensor(moments.steps)}
            tensors |= {f"adam.{name}.exp_avg": moments.mean, f"adam.{name}.exp_avg_sq": moments.square}
        return tensors

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over a checkpoint's values of the tensors that are learned or constant now.

        If a tensor by row is constant in the checkpoint but learned now, its one row is repeated for all surfels. If it is learned in the
        checkpoint but constant now, its first row is taken. Raises KeyError if the checkpoint lacks a tensor by row. Any other tensor that
        it lacks, such as the light, is dropped.
        """
        rows = len(tensors["parameter.position"])
        self.moments.clear()
        for name in [*self._values]:
            value = tensors.get(self._kept(name))
            if value is None and name not in self._by_row:
                self.drop(name)
                continue
            if value is None:
                one = tensors[f"constant.{name}"]
                value = one.expand(rows, *one.shape[1:]).clone()
            self._values[name] = _leaf(value)
            if f"adam.{name}.step" in tensors:
                mean, square = (tensors[f"adam.{name}.{key}"] for key in ("exp_avg", "exp_avg_sq"))
                self.moments[name] = Moments(int(tensors[f"adam.{name}.step"]), mean, square)
        for name in self.constant:
            learned = tensors.get(f"parameter.{name}")
            self.constant[name] = tensors[f"constant.{name}"] if learned is None else learned[:1]

    def _kept(self, name: str) -> str:
        """Return the tensor's name in a checkpoint: "parameter.NAME" for one by row, otherwise `name`."""
        return f"parameter.{name}" if name in self._by_row else name


def belong_together(tensors: Mapping[str, Tensor]) -> bool:
    """Tell whether a checkpoint's tensors are complete and match in shape and type."""
    fine = {"environment", "parameter.position"} <= tensors.keys()
    rows = tensors["parameter.position"].shape[:1] if fine else ()
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        if kind in ("parameter", "constant", "densification"):
            fine &= value.shape[:1] == ((1,) if kind == "constant" else rows)
        if kind in ("parameter", "constant", "environment", "exposure"):
            fine &= value.dtype == (torch.bool if rest in ("held", "told") else torch.float32)
        if kind == "adam":
            of, _, moment = rest.rpartition(".")
            learned = tensors.get(of if of in ("environment", "exposure") else f"parameter.{of}")
            fine &= all(f"adam.{of}.{each}" in tensors for each in ("step", "exp_avg", "exp_avg_sq"))
            fine &= learned is not None and (value.numel() == 1 if moment == "step" else value.shape == learned.shape)
    return fine


def _leaf(value: Tensor) -> Tensor:
    """Return `value` as a leaf of autograd that shares its memory."""
    return value.detach().requires_grad_(value.is_floating_point())
