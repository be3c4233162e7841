"""Concatenate the features of surfels into one tensor."""

from collections.abc import Sequence

from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.clock import timed
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run


class _Work(struct("Stack", "stack.cpp")):
    @classmethod
    def of(cls, stacked: Tensor, widths: Sequence[int], parts: Sequence[Tensor | None]) -> "_Work":
        work = cls(rows=len(stacked), parts=len(widths), width=stacked.shape[1])
        work.attach(stacked=stacked)
        for slot, width, part in zip(work.part, widths, parts, strict=False):
            slot.width, slot.numbers = width, None if part is None else part.data_ptr()
        return work


@timed("surfels")
class _Stack(Function):
    @staticmethod
    def forward(ctx, *parts):
        ctx.widths = [part.shape[1:].numel() for part in parts]
        parts = [part.contiguous() for part in parts]
        stacked = parts[0].new_empty(len(parts[0]), sum(ctx.widths))
        run("refgs_stack", _Work.of(stacked, ctx.widths, parts), stacked, items=len(stacked))
        ctx.shapes = [part.shape for part in parts]
        return stacked

    @staticmethod
    @once_differentiable
    def backward(ctx, by_stacked):
        by_stacked, wanted = by_stacked.contiguous(), zip(ctx.needs_input_grad, ctx.shapes, strict=True)
        parts = [by_stacked.new_empty(shape) if needed else None for needed, shape in wanted]
        run("refgs_unstack", _Work.of(by_stacked, ctx.widths, parts), by_stacked, items=len(by_stacked))
        return tuple(parts)


def stack(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate up to eight float32 tensors, (N,) or (N, C), into (N, ΣC). Differentiable."""
    check(**{f"part {i}": (part, (len(parts[0]), *part.shape[1:2])) for i, part in enumerate(parts)})
    return _Stack.apply(*parts)
