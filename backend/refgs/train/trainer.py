"""Train surfels, one view per iteration. Some iterations also change the light's resolution, make a mesh, or divide surfels."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor

from refgs.capture import Capture, release_memory
from refgs.effective import Effective
from refgs.events import Report
from refgs.memory import trim
from refgs.run_folder import CHECKPOINTS
from refgs.settings import Settings
from refgs.train.decide import needs, photos
from refgs.train.decide.need import Given
from refgs.train.keep import checkpoint, history, snapshot
from refgs.train.keep.measures import Measures
from refgs.train.keep.progress import Means
from refgs.train.learn import coarse, densify, exposures, light, mesh_normals, outlines, poses, priors, trace
from refgs.train.learn.guard import Guard, warn
from refgs.train.learn.losses import departure, objective
from refgs.train.learn.rates import set_rates
from refgs.train.material import even_metal, metals
from refgs.train.plan import Plan, growth
from refgs.train.setup import set_up, start_deferred, start_residual
from refgs.train.state import State
from refgs.train.timeline import AFTER, BEFORE, CHECKPOINT, PLAN, RECORD, REPORT, WHOLE, Row, Step

ACTIONS: dict[str, Callable[[State, Step], object]] = {
    "take larger photos": coarse.refine,
    "start the deferred stage": start_deferred,
    "start the residual": start_residual,
    "set the rates": set_rates,
    "refine the light": light.refine,
    "refine the view's pose": poses.refine,
    "remove the poses' common motion": poses.remove_common,
    "diffuse the light": light.diffuse,
    "balance the exposures": exposures.balance,
    "make a mesh": trace.make_mesh,
    "decide on inter-reflection": needs.reflections,
    "trace what surfels receive": trace.trace_received,
    "time the crops": photos.time_crops,
    "look at a matte scene again": needs.look_again,
    "decide on specular shading": lambda state, step: needs.evaluate(state, "specular", Given(step.done)),
    "decide on the light's texels": lambda state, step: needs.evaluate(state, "light"),
    "decide on degrees of harmonics": lambda state, step: needs.evaluate(state, "degrees"),
    "find metals": metals.find_metals,
    "judge metals": metals.judge,
    "even coloured metal out": even_metal.even_out,
    "level base colours": metals.level_base_colors,
    "find glossy paint": metals.find_glossy_paint,
    "keep paint glossy": metals.keep_paint_glossy,
    "compare highlights": metals.compare_highlights,
    "draw metals' base colours": metals.draw_metals,
    "average paint's base colours": metals.average_paint,
    "keep shades of base colours": metals.keep_shades,
    "prune and divide surfels": densify.prune_and_divide,
    "propagate normals": densify.propagate_normals,
    "reset opacities": densify.reset_opacity,
    "leave out exposures that agree": exposures.leave_out_alike,
    "judge the poses": poses.judge,
}
"""Functions that do what the rows of BEFORE and AFTER name."""


def walk(rows: tuple[Row, ...], state: State, step: Step) -> None:
    """Run the actions of `rows` that are due at this step, in order."""
    for row in rows:
        if row.due(state, step) and row.pays(state):
            with state.clock.part(row.clock) if row.clock else nullcontext():
                ACTIONS[row.what](state, step)


class Trainer:
    """Train surfels, materials and light on a capture, with checkpoints in the run folder."""

    def __init__(
        self,
        capture: Capture,
        settings: Settings | Effective,
        folder: Path,
        report: Report,
        plan: Plan | None = None,
        device: str = "cpu",
    ) -> None:
        effective = settings if isinstance(settings, Effective) else Effective.of(settings)
        self.state = set_up(capture, effective, folder, report, plan or Plan(None), device)
        with self.state.clock.part("reading"):
            self.measures = Measures(self.state)
        self.guard = Guard(self.state.device)
        self._order: tuple[int, list[int]] = (-1, [])

    def step(self) -> dict[str, Tensor]:
        """Do one iteration on one view. Returns its `loss` and its mean squared error, `square`, as scalar tensors.

        On a graphics card, this returns before the tensors are computed. Reading their values waits for the card.
        """
        state = self.state
        step = Step(state, self._next_view())
        walk(BEFORE, state, step)
        figures = self._learn(step)
        step.done += 1
        walk(AFTER, state, step)
        state.iteration = step.done
        return figures

    def _learn(self, step: Step) -> dict[str, Tensor]:
        """Train on the step's view; return `loss` and the mean squared error, `square`."""
        state = self.state
        inputs, step.photo = state.inputs(), coarse.photo(state, step.view, WHOLE.due(state, step))
        step.rendering = state.picture(inputs, step.photo.camera, exposures.exposure(state, step.view))
        mean = light.mean_radiance(state, inputs.environment) if state.told_light is None else None
        loss, square = objective(step.rendering, mean, step.photo, state.background, state.losses, step.progress)
        if "exposure" in state.learned:
            loss = loss + state.settings.loss.exposure * departure(state.learned["exposure"][step.view])
        for given in (outlines.loss(state, step), mesh_normals.loss(state, step), priors.loss(state, step)):
            loss = loss if given is None else loss + given
        loss.backward()
        metals.hold(state)
        accepted = self.guard.judge(loss, state.learned)
        densify.watch(state, step, accepted)
        state.learned.step(accepted)
        state.learned.forget_gradients()
        return {"loss": loss.detach(), "square": square}

    def _next_view(self) -> int:
        """Return the index of the next training view, in each epoch's random order."""
        # The order depends on the seed and the epoch only, so that a resumed run has the same.
        epoch, place = divmod(self.state.iteration, len(self.state.views))
        if self._order[0] != epoch:
            generator = torch.Generator().manual_seed(self.state.settings.train.seed * 1_000_003 + epoch)
            self._order = epoch, torch.randperm(len(self.state.views), generator=generator).tolist()
        return self._order[1][place]

    def run(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Train to the end or until `stop` returns true, save, and return whether it ended."""
        state, means = self.state, self.state.part(Means)
        before, first = state.seconds, state.iteration
        dividing = state.settings.densify
        rounds = (dividing.stop - dividing.start) * state.total / dividing.every if dividing.every else 0
        more = growth(state.learned.count, state.settings.surfels.budget, rounds)
        state.plan.begin(state.iteration, more, state.part(coarse.Coarse).stages)
        while not state.ended and not self._should_stop(stop):
            means.add(self.iterate())  # values are read only now and then, so that the CPU need not wait for a card
            now = Step(state)
            if PLAN.due(state, now):
                state.total = state.plan.total(state.iteration, len(state.views) + len(state.test)) or state.total
            if REPORT.due(state, now) or state.ended:
                release_memory([*state.views, *state.test])
                self._check(whole=state.ended)
                # The training may have gone back to a checkpoint.
                pace = (state.seconds - before) / max(coarse.cost(state, first, state.iteration), 1e-9)
                self._report_progress(pace)
            now = Step(state)
            if RECORD.due(state, now):
                history.record(state, self.measures)
            if CHECKPOINT.due(state, now):
                self.save()
        if state.ended and state.iteration > first:
            history.record(state, self.measures)
        self.save()
        return state.ended

    def _report_progress(self, pace: float) -> None:
        state, means = self.state, self.state.part(Means)
        facts = {"iteration": state.iteration, "total": state.total, "seconds": state.seconds}
        facts |= {"seconds_left": pace * coarse.cost(state, state.iteration, state.total), "loss": means.loss}
        facts |= {"psnr": means.psnr, "splats": state.learned.count}
        state.report("progress", facts)

    def _should_stop(self, stop: Callable[[], bool]) -> bool:
        """Call `stop` and return its answer, without counting its pause as training time."""
        begun = time.perf_counter()
        stopped = stop()
        self.state.plan.wait(time.perf_counter() - begun)
        return stopped

    def iterate(self) -> dict[str, Tensor]:
        """Do one iteration, and add its time to `state.seconds`. Returns what `step` returns.

        If the graphics card runs out of memory, the number of surfels is reduced and the iteration is tried again.
        """
        begun, used = time.perf_counter(), time.process_time()
        figures = self._try_step()
        while figures is None:  # try again outside the attempt, whose traceback held its tensors
            densify.fewer_surfels(self.state)
            figures = self._try_step()
        self.state.seconds += time.perf_counter() - begun
        self.state.clock.processor += time.process_time() - used
        return figures

    def _try_step(self) -> dict[str, Tensor] | None:
        """Do one iteration like `step`; return None if the graphics card's memory is full."""
        try:
            with self.state.clock.iteration(self.state.iteration):
                return self.step()
        except torch.OutOfMemoryError:
            return None

    def save(self) -> None:
        """Write a checkpoint, after a check that all numbers in it are finite (see `Guard.look`)."""
        self._check(whole=True)
        with self.state.clock.part("writing"):
            snapshot.save(self.state)
            trim()  # free the memory that decisions took

    def _check(self, whole: bool) -> None:
        """Go back to the last checkpoint, with a warning, if `Guard.look` gives a reason."""
        state = self.state
        if why := self.guard.look(state, whole, lambda: checkpoint.complete(state.folder / CHECKPOINTS)):
            spent = state.seconds, dict(state.clock.seconds), state.plan.before
            self.resume()
            state.seconds, state.clock.seconds, state.plan.before = spent
            warn(state, why)

    def release_photos(self) -> None:
        """Drop all photos after the training, because Windows cannot remove mapped files."""
        self.state.views, self.state.photos, self.state.test = [], [], []
        self.state.part(coarse.Coarse).photos = []
        del self.measures

    def resume(self) -> None:
        """Resume from the last undamaged checkpoint; without one, raise NoCheckpoint unless at iteration 0."""
        try:
            snapshot.restore(self.state, self.state.folder)
        except checkpoint.NoCheckpoint:
            if self.state.iteration:
                raise
        history.trim(self.state.folder, self.state.iteration, self.state.report)
