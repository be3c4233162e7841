"""Train all captures of a batch: hand their steps, such as `refgs train`, to Ray, follow them, and write a page about them."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from refgs.batch.engine import Engine, started
from refgs.batch.graph import OPTIONAL, Node, steps_of
from refgs.batch.listing import LOGS, Ask, Job, read_jobs
from refgs.batch.page import Row, figures_of, picture_of, write_page, write_rows
from refgs.batch.resources import card_share, memory
from refgs.batch.steps import Outcome, Step, recorded
from refgs.errors import TRY_AGAIN, InputError
from refgs.events import Report
from refgs.formats.progress import Progress
from refgs.formats.validate import read_json
from refgs.lock import PROGRESS, RunLock
from refgs.paths import disk_errors_named

ROWS = "rows.json"  # in LOGS: the table for other programs
REREAD_EVERY = 5.0  # seconds between looks for new captures
CANCEL_EVERY = 5.0  # seconds until what has not ended is told again: on a busy machine, Ray now and then loses it
WRITE_EVERY = 1.0  # seconds between writes of the table
SETTLED = 10.0  # seconds without a change after which a new capture's files are taken to be complete


@dataclass
class _Run:
    """Hold one training: its steps by name, and the outcomes of ended steps."""

    job: Job
    nodes: dict[str, Node]
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    picture: Path | None = None

    @property
    def ended(self) -> bool:
        return len(self.outcomes) == len(self.nodes)

    @property
    def failed(self) -> tuple[str, Outcome] | None:
        """Return the name and outcome of the first failed step except `masks`, or None."""
        bad = [(name, found) for name in self.nodes if (found := self.outcomes.get(name)) and found.status]
        return next((pair for pair in bad if pair[0] not in OPTIONAL), None)

    @property
    def seconds(self) -> float:
        return sum(outcome.seconds for outcome in self.outcomes.values())

    @property
    def complete(self) -> bool:
        return self.ended and all(outcome.status is not None for outcome in self.outcomes.values())

    def working(self) -> list[str]:
        """List the names of the steps that run now."""
        return [name for name, node in self.nodes.items() if name not in self.outcomes and node.step.running.exists()]


class Batch:
    """Train all captures of a list or folder, and write a page about them."""

    def __init__(self, source: Path, out: Path, ask: Ask, device: str, report: Report):
        """Read the trainings that `source` lists. Raises InputError if one is wrong."""
        self._source, self._out, self._ask, self._device, self._report = source, out.resolve(), ask, device, report
        self._runs: dict[str, _Run] = {}
        self._references: dict[Step, Any] = {}  # trainings of one capture share its first steps
        self._outcomes: dict[Step, Outcome] = {}
        self._looked, self._wrote, self._said = time.monotonic(), 0.0, ""
        self._jobs = read_jobs(source, out, ask)

    def run(self, engine: Engine, stop: Callable[[int, int, float], bool]) -> int:
        """Run all steps. Captures that are added while the batch runs are trained, too.

        Returns the exit status:

        - TRY_AGAIN if the batch was stopped, or if a step failed for a reason that may pass
        - otherwise 1 or 2 if a step failed with this status, and 1 if both occurred
        - otherwise 0

        `stop(done, total, seconds)` is called about once a second: `done` of `total` runs have ended, and `seconds` have passed. If it
        returns True, all commands are ended; trainings write checkpoints first.

        Raises InputError if the device is "cuda" and no machine has a CUDA card.
        """
        if self._device == "cuda" and not engine.cards:
            raise InputError("--device cuda: no machine here has a CUDA card that Ray knows of: take auto or cpu")
        card = engine.card_bytes() if engine.cards and self._device != "cpu" else None
        begun, stopped, cancelled = time.monotonic(), False, -math.inf
        for job in self._jobs:
            self._submit(job, engine, card)
        self._tell()
        while not all(run.ended for run in self._runs.values()):
            for step, outcome in engine.ended(1.0):
                self._outcomes[step] = outcome
                for run in self._runs.values():
                    if step.name in run.nodes and run.nodes[step.name].step == step:
                        self._note(run, step.name, outcome)
            self._tell()
            done = sum(run.ended for run in self._runs.values())
            stopped = stopped or stop(done, len(self._runs), time.monotonic() - begun)
            if stopped and time.monotonic() > cancelled + CANCEL_EVERY:
                cancelled = time.monotonic()
                engine.cancel()
            if not stopped and time.monotonic() > self._looked + REREAD_EVERY:
                for job in self._added():
                    self._submit(job, engine, card)
        self._write_rows()
        write_page(self._out, [self._row(run) for run in self._runs.values()], time.monotonic() - begun)
        return self._status(stopped)

    def _row(self, run: _Run) -> Row:
        failed, step, part = run.failed, "", None
        if failed or run.ended:
            state = "failed" if failed else "done" if run.complete else "stopped"
        else:
            working = run.working()
            state, step = "running" if working else "waiting", next(iter(working), "")
            done, total = _progress(self._out / run.job.name) if step == "train" else (0, 0)
            part = done / total if total else None
        what, log = (f"{failed[0]}: {failed[1].what}", run.nodes[failed[0]].step.log) if failed else ("", None)
        known = run.figures, run.picture
        return Row(run.job.name, run.job.capture, state, run.seconds, what, log, step, part, *known)

    def _write_rows(self) -> None:
        """Write rows.json, in which other programs read the state of each run."""
        self._wrote = time.monotonic()
        (self._out / LOGS).mkdir(exist_ok=True)  # somebody may have moved it away
        write_rows(self._out / LOGS / ROWS, [self._row(run) for run in self._runs.values()])

    def _submit(self, job: Job, engine: Engine, card: int | None) -> None:
        """Submit a training's new steps; `card` is a CUDA card's memory in bytes, or None."""
        # Steps are left out that an earlier batch has done, or that another training of the same capture has handed over.
        run = _Run(job, {node.step.name: node for node in steps_of(job, self._out, self._device)})
        self._runs[job.name] = run
        settings = job.settings()
        share = card_share(settings, card) if card else 0.0
        for name, node in run.nodes.items():
            step = node.step
            if step not in self._references and (outcome := recorded(step)) is not None:
                self._references[step] = self._outcomes[step] = outcome
            elif step not in self._references:
                before = [(self._references[run.nodes[other].step], False) for other in node.after]
                before += [(self._references[run.nodes[other].step], True) for other in node.may_fail]
                self._references[step] = engine.submit(
                    step, memory(settings), share if name == "train" else 0.0, before
                )
            if step in self._outcomes:
                run.outcomes[name] = self._outcomes[step]
        self._look(run)
        if run.ended:
            self._report("ended", {"run": job.name, "what": f"{job.name}: done before"})

    def _note(self, run: _Run, name: str, outcome: Outcome) -> None:
        run.outcomes[name] = outcome
        self._look(run)
        if not run.ended:
            return
        if failed := run.failed:
            what = f"{failed[0]} failed: {failed[1].what}"
        else:
            what = f"done in {run.seconds:.0f} s" if run.complete else "stopped"
        self._report("ended", {"run": run.job.name, "what": f"{run.job.name}: {what}"})

    def _look(self, run: _Run) -> None:
        """Update a run's `figures` and `picture` from the files in its folder."""
        folder = self._out / run.job.name
        run.figures, run.picture = figures_of(folder), picture_of(folder)

    def _tell(self) -> None:
        """Report the batch's progress, and write rows.json at most every WRITE_EVERY seconds."""
        working = []
        for run in self._runs.values():
            for name in run.working():
                done, total = _progress(self._out / run.job.name) if name == "train" else (0, 0)
                working.append({"run": run.job.name, "step": name, "done": done, "total": total})
        ended = [run for run in self._runs.values() if run.ended]
        facts = {"done": len(ended), "total": len(self._runs), "failed": sum(run.failed is not None for run in ended)}
        self._report("progress", facts | {"working": working})
        if time.monotonic() > self._wrote + WRITE_EVERY:
            self._write_rows()

    def _added(self) -> list[Job]:
        """Return the added trainings with completely copied captures, or [] if the list is wrong."""
        self._looked = time.monotonic()
        try:
            jobs = read_jobs(self._source, self._out, self._ask)
        except InputError as error:
            if str(error) != self._said:
                self._said = str(error)
                self._report("warning", {"what": f"{error}; what was read before goes on"})
            return []
        return [job for job in jobs if job.name not in self._runs and _settled(job.capture)]

    def _status(self, stopped: bool) -> int:
        statuses = {run.failed[1].status for run in self._runs.values() if run.failed}
        if stopped or TRY_AGAIN in statuses:
            return TRY_AGAIN
        return next((status for status in (1, 2) if status in statuses), 0)


@contextmanager
def ready(
    source: Path,
    out: Path,
    ask: Ask,
    device: str,
    report: Report,
    cores: int | None = None,
    workers: int | None = None,
    address: str | None = None,
) -> Iterator[Callable[[Callable[[], bool]], int]]:
    """Check a batch, start Ray and lock the folder of the runs, for a `with` block. Arguments are as for `refgs batch`.

    Yields the function run(stop), which runs the batch and returns its exit status. `stop()` is called about once a second. If it returns
    True, all commands are ended; trainings write checkpoints first. Raises InputError if something is wrong with the captures, Ray or the
    folder.
    """
    work = Batch(source, out, ask, device, report)
    with started(address, cores, workers) as engine:
        try:
            (out / LOGS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{out}: the folder cannot be made ({error.strerror}): choose another") from None
        again = "run the same command again"
        lent = engine.lending(out.resolve() / LOGS) if address else nullcontext()
        with RunLock(out / LOGS) as lock, disk_errors_named([out], again), lent:
            yield lambda stop: work.run(engine, lambda *facts: lock.attend(*facts) or stop())


def _progress(run: Path) -> tuple[int, int]:
    """Return a training's present iteration and total, both 0 if they are unknown."""
    try:
        facts = read_json(run / PROGRESS, Progress, "")
    except InputError:
        return 0, 0
    return facts.iteration, facts.total


def _settled(capture: Path) -> bool:
    """Tell whether no file of a capture has changed in the last SETTLED seconds."""
    try:
        changed = max(path.stat().st_mtime for path in [capture, *capture.rglob("*")])
    except OSError:
        return False
    # A clock that went back, or another machine's, dates files into the future.
    return abs(time.time() - changed) > SETTLED
