"""Test training on CUDA without a GPU.

The tests use emulated kernels, or fake tensors that have a shape and a device but no values.
"""

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode, unset_fake_temporarily

from refgs.kernels import cuda
from refgs.model import prefilter
from refgs.render import raster_cuda, shade
from refgs.train.learn.light import MirroredLight
from tests.makers.emulate import emulate
from tests.makers.occluders import as_occluder
from tests.makers.training import TINY, copied, trainer

CARD = torch.device("cuda:0")
# At a metallic of 0.5, a metal and a dielectric are so equally bright that derivatives are only rounding.
START = [*TINY, "surfels.metallic=0.8"]


@pytest.mark.parametrize(
    "changes", [["indirect.start=0"], ["render.shading=sh"], ["initial.until=0.99", "needs.initial=on"]]
)
def test_trains_as_the_cpu_does(ball_capture, tmp_path, monkeypatch, changes):
    """Check that training with the CPU's kernels and with emulated CUDA kernels gives nearly the same first three steps."""
    start, figures, values = trainer(ball_capture, tmp_path / "start", *START, *changes, total=3000), [], []
    for name in ("cpu", "card"):
        made = copied(start, tmp_path / name)
        if "indirect.start=0" in changes:
            made.state.occluder = as_occluder(trimesh.creation.torus(1.0, 0.3), scale=made.state.capture.radius)
        if name == "card":
            emulate(monkeypatch)
        steps = [made.step() for _ in range(3)]
        figures.append([[float(step[name]) for name in ("loss", "square")] for step in steps])
        values.append({name: value for name, value in made.state.learned.by_row.items() if value.is_floating_point()})
    np.testing.assert_allclose(figures[0], figures[1], rtol=1e-3)
    for name, value in values[0].items():
        # Adam's first steps follow the sign of the gradient, which rounding may flip where gradients are tiny.
        off = (value - values[1][name]).abs() > 1e-3 * value.abs().max()
        assert float(off.float().mean()) < 0.05, name


def follow_to_the_card(monkeypatch) -> list[str]:
    """Replace parts of the program so that it runs on fake CUDA tensors. Return a list that receives the names of launched kernels."""

    def empty(value):
        if isinstance(value, Tensor):
            return torch.empty(value.shape, dtype=value.dtype, device=CARD)
        if isinstance(value, tuple | list):
            moved = map(empty, value)
            return type(value)(*moved) if hasattr(value, "_fields") else type(value)(moved)
        return value

    def computed_on_the_cpu(make):  # tables that numpy computes
        def made(*arguments):
            with unset_fake_temporarily():
                value = make(*arguments[:-1], torch.device("cpu"))
            return empty(value)

        return made

    tables = [(prefilter, "matrices"), (prefilter, "_pyramid"), (prefilter, "_order")]
    for home, name in [*tables, (shade, "_reflectance"), (shade._Padding, "of")]:
        monkeypatch.setattr(home, name, computed_on_the_cpu(getattr(home, name)))
    launched = []
    monkeypatch.setattr(cuda, "launch", lambda name, *_: launched.append(name))
    monkeypatch.setattr(raster_cuda, "how_many", lambda ends: 1000)
    monkeypatch.setattr(FakeTensor, "data_ptr", lambda tensor: 0, raising=False)
    monkeypatch.setattr(Tensor, "backward", backward)
    return launched


def backward(loss: Tensor) -> None:
    """Compute gradients without autograd's own engine, which needs a GPU: visit the nodes of the graph from the loss backwards.

    In each autograd function, the arguments that have a derivative must come first.
    """
    order: list = []

    def visit(node) -> None:
        if node is not None and node not in order:
            for below, _ in node.next_functions:
                visit(below)
            order.append(node)

    visit(loss.grad_fn)
    gradients = {loss.grad_fn: {0: torch.ones_like(loss)}}
    with torch.no_grad():
        for node in reversed(order):
            found = gradients.get(node, {})
            if hasattr(node, "variable"):
                node.variable.grad = found[0]
                continue
            blank = [torch.zeros(m.shape, dtype=m.dtype, device=m.device) for m in node._input_metadata]
            passed = getattr(node, "apply", node)(*(found.get(i, zero) for i, zero in enumerate(blank)))
            passed = passed if isinstance(passed, tuple) else (passed,)
            for (below, i), value in zip(node.next_functions, passed, strict=False):
                if below is not None and value is not None:
                    slot = gradients.setdefault(below, {})
                    slot[i] = slot[i] + value if i in slot else value


@pytest.mark.parametrize("indirect", [False, True])
def test_an_iteration_stays_on_the_card(ball_capture, tmp_path, monkeypatch, indirect):
    """Check that a training step keeps all its tensors on the GPU, and that the CPU reads no value back, except in `how_many`.

    The tensors are fake: reading a value is an error, and so is making a tensor whose size depends on a value. The rasteriser's `how_many`
    must read a value, so the test replaces it by a function that returns a constant.
    """
    ball = as_occluder(trimesh.creation.icosphere(2))
    tree = ball.tree(torch.device("cpu"))
    launched = follow_to_the_card(monkeypatch)
    with FakeTensorMode(allow_non_fake_inputs=True):
        changes = f"indirect.start={0 if indirect else 1}", "light.frame=world"  # "auto" would be decided on the CPU
        made = trainer(ball_capture, tmp_path / "run", *START, *changes, total=3000, device="cuda")
        with unset_fake_temporarily():
            made._next_view()  # shuffles the order of views on the CPU
        if indirect:
            tree._boxes, tree._triangles = (torch.empty(v.shape, device=CARD) for v in (tree._boxes, tree._triangles))
            made.state.occluder = ball
        # The training computes at its start which texels of the light the object shows.
        made.state.part(MirroredLight).weight = torch.empty(len(made.state.learned["environment"]), device=CARD)
        figures = made.step()
        assert all(figure.device == CARD for figure in figures.values())
        assert all(value.grad is None and value.device == CARD for value in made.state.learned.values())
    stages = ["activate", "sparse", "raster_project", "raster_forward", "shade_forward"]
    stages += ["losses", "ssim", "raster_backward", "adam"]
    for stage in stages + ["trace", "harmonics"] * indirect:
        assert any(stage in name for name in launched), stage
