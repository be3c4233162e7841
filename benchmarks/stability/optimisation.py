"""Test trainings: after a disturbance they must recover, and when repeated they must give the same bits."""

import functools
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.stability.cases import Case, Outcome
from benchmarks.stability.geometry import camera, surfels
from benchmarks.stability.photos import NOISE
from benchmarks.stability.training import TOTAL, ball, train, trainer, usual
from refgs.errors import InputError
from refgs.model.learned import Learned
from refgs.render import reference
from refgs.render.rasterize import rasterize
from refgs.settings import RATES
from refgs.train.start import GEOMETRY
from refgs.train.timeline import faint_now
from refgs.train.trainer import Trainer

AT, UNTIL, LONG = 50, 90, 300  # iterations: start and end of a disturbance, length of a long training


def disturbed(
    start: Callable[[Trainer], None], end: Callable[[Trainer], None] | None = None, total: int = TOTAL
) -> Outcome:
    """Train for `total` iterations with and without a disturbance. Measure the PSNR (dB) lost at the end, and how long the recovery took.

    At iteration AT, the function `start` changes the trainer. At iteration UNTIL, the function `end` undoes the change, if it is given.
    """
    course = train(ball(), total=total, disturb={AT: start} | ({UNTIL: end} if end else {}))
    since = UNTIL if end else AT
    return Outcome(course.finite, max(0.0, usual(total).end - course.end), course.back_after(since, usual(total)))


def faster(factor: float, geometry: bool) -> Callable[[Trainer], None]:
    """Return a function that multiplies a trainer's learning rates by `factor`.

    If `geometry` is set, only the rates of geometry change, otherwise only those of light and materials.
    """

    def change(made: Trainer) -> None:
        rates = made.state.settings.rates
        changed = {name: factor * getattr(rates, name) for name in RATES if (name in GEOMETRY) == geometry}
        _set(made, "rates", changed)

    return change


def _set(made: Trainer, section: str, values: dict[str, float]) -> None:
    for name, value in values.items():
        made.state.change(f"{section}.{name}", value, "plan", "disturbed")


def heavier(factor: float) -> Callable[[Trainer], None]:
    """Return a function that multiplies a trainer's loss weights by `factor`, except D-SSIM's, which is a fraction and not a weight."""

    def change(made: Trainer) -> None:
        loss = made.state.settings.loss
        weights = {name: factor * value for name, value in loss.model_dump().items() if name != "dssim"}
        _set(made, "loss", weights)

    return change


def nan_gradient(name: str, every: bool = False) -> Callable[[Trainer], None]:
    """Return a function that puts a NaN into the gradient of a trainer's parameter `name` at the next step.

    If `every` is set, it does so at all later steps, too.
    """

    def change(made: Trainer) -> None:
        judge = made.guard.judge

        def judged(loss: Tensor, learned: Learned) -> Tensor:
            if not every:
                made.guard.judge = judge
            made.state.learned[name].grad.view(-1)[7] = math.nan
            return judge(loss, learned)

        made.guard.judge = judged

    return change


def nan_value(name: str) -> Callable[[Trainer], None]:
    def change(made: Trainer) -> None:
        made.state.learned[name].data.view(-1)[10:13] = math.nan

    return change


def stopped() -> Outcome:
    """Train with gradients that stay NaN from some iteration on.

    Check that the training returns to its last checkpoint, fails again, and then ends with a one-line error.
    """
    try:
        train(ball(), disturb={AT: nan_gradient("albedo", every=True)})
    except InputError as error:
        return Outcome("again after going back" in str(error), 0.0)
    return Outcome(False, 1.0)


def with_settings(*changes: str, total: int = TOTAL) -> Outcome:
    course = train(ball(), *changes, total=total)
    return Outcome(course.finite, max(0.0, usual(total).end - course.end))


def trajectories() -> Outcome:
    """Take thirty steps of Adam twice: with the float32 kernels, and with the float64 reference.

    The error is the difference of the two final pictures, divided by how much the picture changed during the steps.
    """
    view = camera(size=(24, 18))
    target = reference.rasterize(*(v.double() for v in surfels(view, 60)), view, 0.1)[0].float()
    start = surfels(view, 60)
    start[0] = start[0] + 0.02 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    start[4] = 0.5 * start[4]
    pictures, first = [], None
    for dtype in (torch.float32, torch.float64):
        leaves = [v.to(dtype).clone().requires_grad_() for v in start]
        rates = (1e-3, 1e-3, 1e-3, 1e-3, 1e-2)
        if dtype == torch.float32:
            optimizer = Learned()
            for number, (leaf, rate) in enumerate(zip(leaves, rates, strict=True)):
                optimizer.learn(str(number), leaf)
                optimizer.rates[str(number)] = rate
            leaves = [*optimizer.values()]
        else:
            groups = [{"params": [v], "lr": rate} for v, rate in zip(leaves, rates, strict=True)]
            optimizer = torch.optim.Adam(groups, eps=Learned.EPSILON)
        draw = rasterize if dtype == torch.float32 else reference.rasterize
        for _ in range(30):
            picture = draw(*leaves, view, 0.1)[0]
            first = picture.detach().double() if first is None else first
            ((picture - target) ** 2).mean().backward()
            optimizer.step()
            for leaf in leaves:
                leaf.grad = None
        pictures.append(draw(*leaves, view, 0.1)[0].detach().double())
    error = float((pictures[0] - pictures[1]).norm() / (pictures[1] - first).norm())
    return Outcome(bool(pictures[0].isfinite().all()), error)


STAGES = ["initial.until=0.25", "indirect.start=0.3", "indirect.every=15", "indirect.least=0", "indirect.resolution=32"]
STAGES += [
    "densify.every=10",
    "densify.reset_every=55",
    "propagation.every=20",
    "propagation.rest=15",
    "light.exposure=on",
]
STAGES += ["train.checkpoint_every=1000", "residual.start=0.8", "needs.initial=on", "needs.reflections=on"]
CUTS: dict[int, Callable[[Trainer], bool]] = {
    5: lambda made: made.state.initial and made.state.iteration < made.state.settings.train.light_first,
    20: lambda made: made.state.initial,
    37: lambda made: not made.state.initial and made.state.occluder is None,
    52: lambda made: made.state.occluder is not None,
    75: lambda made: faint_now(made.state, made.state.iteration),
    90: lambda made: made.state.iteration > made.state.residual_start * made.state.total,
}
"""Iterations to stop at and a test for each stage: light first, per surfel, deferred, inter-reflection, after a reset, residual."""


def bits(made: Trainer) -> list[Tensor]:
    return [
        *(value.detach() for _, value in sorted(made.state.learned.items())),
    ]


def resumed() -> Outcome:
    """Stop a training in each of its stages, such as before and after inter-reflection starts, and resume it.

    The error is the fraction of tensors that differ from those of a training without a stop.
    """
    whole = trainer(ball(), *STAGES, total=100)
    copies: dict[int, Path] = {}
    for cut, in_stage in CUTS.items():
        whole.run(stop=lambda cut=cut: whole.state.iteration >= cut)
        assert in_stage(whole), f"at {cut} the training is in another stage than it should be"
        copies[cut] = whole.state.folder.with_name(f"{whole.state.folder.name} {cut}")
        shutil.copytree(whole.state.folder, copies[cut])
    whole.run()
    others = []
    for folder in copies.values():
        made = trainer(ball(), *STAGES, total=100, folder=folder)
        made.resume()
        made.run()
        others.append(made)
    return same(whole, others)


def same(whole: Trainer, others: list[Trainer]) -> Outcome:
    differ = [
        a.shape != b.shape or not torch.equal(a, b)
        for made in others
        for a, b in zip(bits(whole), bits(made), strict=True)
    ]
    return Outcome(all(bool(v.isfinite().all()) for v in bits(whole)), sum(differ) / len(differ))


def threads() -> Outcome:
    """Train the same scene with one, two and three threads. The error is the fraction of tensors that differ."""
    before, made = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            made.append(trainer(ball(), *STAGES, total=60))
            made[-1].run()
    finally:
        torch.set_num_threads(before)
    return same(made[0], made[1:])


REJECTED = "the step is not taken, and counted"
REMOVED = "surfels that are not finite are removed, and that is said"
SEED = "what another seed changes"


def _case(name: str, run, guard: str, most: float = NOISE, because: str = SEED, against: str = "undisturbed") -> Case:
    return Case(f"optimisation: {name}", run, against, most, because, guard, "dB")


RESETS = "densify.reset_every=50", "densify.every=50", "densify.start=0.05", "densify.stop=0.15"
LATE = "it has cooled before all is found again"
LOST = "positions fly off by radii: to be finite is all that is asked"
RUINED = "Adam remembers large gradients: to be finite is all that is asked"
LIMITED = "raw values are kept within limits where their slopes still count"
CASES = [
    *(
        _case(
            f"rates of {what} × {factor} for 40 iterations",
            functools.partial(disturbed, faster(factor, geometry), faster(1 / factor, geometry), LONG),
            LIMITED,
            *most,
        )
        for factor, geometry, what, most in (
            (10, False, "light and materials", (3.0, LATE)),
            (100, False, "light and materials", (25.0, RUINED)),
            (10, True, "geometry", (3.0, LATE)),
            (100, True, "geometry", (25.0, LOST)),
        )
    ),
    _case("loss weights × 100 for 40 iterations", lambda: disturbed(heavier(100), heavier(0.01), LONG), "", 2.0, LATE),
    _case(
        "opacity resets and densification in one step",
        lambda: with_settings(*RESETS, total=900),
        "none are removed or divided, and no need is decided, until what was made faint can be back",
        4.0,
        LATE,
    ),
    _case(
        "budget reached at once",
        lambda: with_settings("surfels.start=600", "surfels.budget=600"),
        "none are divided",
    ),
    *(
        _case(f"a NaN in the gradient of {name}", functools.partial(disturbed, nan_gradient(name)), REJECTED)
        for name in ("position", "albedo")
    ),
    *(
        _case(f"NaN in {name} of surfels", functools.partial(disturbed, nan_value(name)), REMOVED)
        for name in ("position", "scale", "opacity", "albedo", "roughness")
    ),
    _case(
        "NaN in the light", lambda: disturbed(nan_value("environment")), "back to the last checkpoint, and that is said"
    ),
    _case(
        "gradients that are never finite again",
        stopped,
        "back to the last checkpoint; then an end",
        0.0,
        "it is so or not",
        "one line",
    ),
    Case(
        "optimisation: 30 steps in float32",
        trajectories,
        "float64 trajectory",
        1e-2,
        "Adam takes a gradient's sign at first, even of rounding",
        "",
    ),
    Case(
        f"optimisation: resumed in {len(CUTS)} stages",
        resumed,
        "the run in one go, bits",
        0.0,
        "the same bits",
        "a checkpoint holds all that the next iteration depends on",
    ),
    Case(
        "optimisation: on one, two and three threads",
        threads,
        "one another, bits",
        0.0,
        "the same bits",
        "no sum depends on who adds",
    ),
]
