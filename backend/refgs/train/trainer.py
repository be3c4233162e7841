"""Train surfels, one view per iteration. Some iterations also change the light's resolution, trace a mesh, or divide surfels."""

import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from refgs.capture import Capture, release_memory
from refgs.compare.metrics import decibels
from refgs.events import Report
from refgs.memory import trim
from refgs.settings import Settings
from refgs.train.decide import needs
from refgs.train.effective import Effective
from refgs.train.keep import checkpoint, history, snapshot
from refgs.train.keep.measures import Measures
from refgs.train.learn import coarse, densify, exposures, light, poses, priors
from refgs.train.learn.guard import Guard, running, warn
from refgs.train.learn.losses import departure, objective
from refgs.train.learn.rates import set_rates
from refgs.train.learn.trace import trace_due
from refgs.train.material import even_metal, metals
from refgs.train.plan import Plan, growth
from refgs.train.setup import set_up, start_deferred

REPORT_EVERY = 10  # iterations


class Trainer:
    """Train surfels, materials and light on a capture. Checkpoints in the run folder allow a run to be resumed."""

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
        state, view = self.state, self._next_view()
        progress = min(state.iteration / state.total, 1.0)
        coarse.refine_due(state, progress)
        photo = state.photo(view, whole=state.iteration % needs.WHOLE_EVERY == 0, reduced=True)
        if state.initial and progress >= state.settings.initial.until:
            start_deferred(state)
        set_rates(state, progress)
        light.refine_due(state, progress)

        inputs = state.inputs()
        rendering = state.picture(inputs, photo.camera, state.exposure(view))
        mean = light.mean_radiance(state, inputs.environment)
        loss, square = objective(rendering, mean, photo, state.background, state.losses, progress)
        if "exposure" in state.learned:
            loss = loss + state.settings.loss.exposure * departure(state.learned["exposure"][view])
        if (leaning := priors.loss(state, view, rendering, photo, progress)) is not None:
            loss = loss + leaning
        loss.backward()
        metals.hold(state)
        accepted, position = self.guard.judge(loss, state.learned), state.learned["position"]
        state.motion.add(position.detach(), position.grad, state.photos[view].camera, accepted)
        state.learned.step(accepted)
        poses.refine_due(state, view, rendering, photo, progress)
        if inputs.environment is not None:
            light.diffuse(state)
        exposures.balance(state)
        state.learned.forget_gradients()
        state.iteration += 1

        trace_due(state, progress)  # meshes and decisions come before an opacity reset makes all surfels faint
        with state.clock.part("deciding"):
            needs.evaluate_iteration(state, progress)
            metals.set_metals_due(state, progress)
            metals.judge_due(state, progress)
        even_metal.even_out_due(state, progress)
        densify.densify_due(state, progress)
        densify.reshape_due(state)
        exposures.leave_out_alike(state, progress)
        poses.put_back_if_worse(state, progress)
        return {"loss": loss.detach(), "square": square}

    def _next_view(self) -> int:
        """Choose the next view. Each epoch takes every view once, in a random order.

        The order depends only on the seed and the epoch, so that a resumed run takes the same one.
        """
        epoch, place = divmod(self.state.iteration, len(self.state.views))
        if self._order[0] != epoch:
            generator = torch.Generator().manual_seed(self.state.settings.train.seed * 1_000_003 + epoch)
            self._order = epoch, torch.randperm(len(self.state.views), generator=generator).tolist()
        return self._order[1][place]

    def run(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Train to the end, or until `stop` returns true. Returns whether the end was reached.

        A checkpoint is written in both cases.
        """
        state, means = self.state, {}
        before, first = state.seconds, state.iteration
        more = growth(state.learned.count, state.settings.surfels.budget)
        state.plan.begin(state.iteration, more, state.stages)
        while not state.ended and not self._should_stop(stop):
            figures = self.iterate()
            state.total = state.plan.total(state.iteration, len(state.views) + len(state.test)) or state.total
            # Running means, read now and then: a card need not wait.
            means = {name: running(means.get(name, figure), figure) for name, figure in figures.items()}
            if state.iteration % REPORT_EVERY == 0 or state.iteration == state.total:
                release_memory([*state.views, *state.test])
                self._check(whole=state.ended)
                pace = (state.seconds - before) / max(state.cost(first, state.iteration), 1e-9)  # it may have gone back
                self._report_progress(means, pace)
            if history.due(state.iteration) and not state.ended:
                self._record(means)
            if state.iteration % state.settings.train.checkpoint_every == 0 and not state.ended:
                self.save()
        if state.ended and means:
            self._record(means)
        self.save()
        return state.ended

    def _report_progress(self, means: dict[str, Tensor], pace: float) -> None:
        state = self.state
        facts = {"iteration": state.iteration, "total": state.total, "seconds": state.seconds}
        facts |= {"seconds_left": pace * state.cost(state.iteration, state.total), "loss": float(means["loss"])}
        facts |= {"psnr": decibels(float(means["square"])), "splats": state.learned.count}
        state.report("progress", facts)

    def _record(self, means: dict[str, Tensor]) -> None:
        history.record(self.state, self.measures, float(means["loss"]), decibels(float(means["square"])))

    def _should_stop(self, stop: Callable[[], bool]) -> bool:
        """Call `stop` and return its answer.

        While `stop` does not return, the training is paused. A time limit does not count that time.
        """
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
        while figures is None:  # out of the attempt, whose traceback held its tensors
            densify.fewer_surfels(self.state)
            figures = self._try_step()
        self.state.seconds += time.perf_counter() - begun
        self.state.processor_seconds += time.process_time() - used
        return figures

    def _try_step(self) -> dict[str, Tensor] | None:
        """Do one iteration. Returns what `step` returns, or None if the graphics card has run out of memory."""
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
            trim()  # what decisions took

    def _check(self, whole: bool) -> None:
        """Check that the training's numbers are finite. If the guard says so, go back to the last checkpoint.

        `whole` is passed on to `Guard.look`. The lost time still counts as training time.
        """
        state = self.state
        if why := self.guard.look(state, whole):
            spent = state.seconds, dict(state.clock.seconds), state.plan.before
            self.resume()
            state.seconds, state.clock.seconds, state.plan.before = spent
            warn(state, why)

    def release_photos(self) -> None:
        """Drop all photos, when the training has ended: the files that they are mapped from can then be removed, on Windows, too."""
        self.state.views, self.state.photos, self.state.test, self.state.reduced = [], [], [], None
        del self.measures

    def resume(self) -> None:
        """Resume from the last complete checkpoint that is not damaged. Start over, from the first iteration, if there is none."""
        try:
            snapshot.restore(self.state, self.state.folder)
        except checkpoint.NoCheckpoint:
            if self.state.iteration:
                raise
        history.trim(self.state.folder, self.state.iteration, self.state.report)
