"""Make the steps of a training: find cameras, make masks, train, evaluate, export. Each step is a command line, and can be run again."""

import os
from pathlib import Path
from typing import NamedTuple

from refgs.asked import Asked
from refgs.batch.listing import LOGS, Job
from refgs.batch.steps import Step
from refgs.capture import find_layout

SHARED = ("poses", "masks")  # steps of a capture: its trainings by several settings share them
OPTIONAL = ("masks",)  # steps whose failure counts only if the training fails, too


class Node(NamedTuple):
    """Hold a step and the steps it waits for; those in `may_fail` may fail."""

    step: Step
    after: tuple[str, ...] = ()
    may_fail: tuple[str, ...] = ()


def steps_of(job: Job, out: Path, device: str) -> list[Node]:
    """List the steps of a training whose run folder is made in `out`. A step comes after all steps that it waits for.

    The step `masks` may fail. The training then reconstructs everything that the photos show. Steps never work in the same run folder at
    the same time: a step that locks the folder removes half-written files, because it takes them for leftovers of killed processes.
    """
    run, capture, ask = (out / job.name).resolve(), str(job.capture), job.ask
    logs = run.parent / LOGS
    preset, files = ask.preset, ()
    if preset and os.path.isfile(preset):
        preset = os.path.realpath(preset)
        files = (Path(preset),)

    def step(name: str, *words: str, made: Path | None = None) -> Step:
        if name in SHARED:
            owner, reads, written = job.capture_name, (), job.capture
        else:
            owner, reads, written = job.name, (job.capture, *files), run
        log = logs / owner / f"{name}.log"
        return Step(name, owner, (name, *words, "--once"), log, made, reads, (written, log.parent))

    asked = Asked(job.capture, run, preset, device, ask.minutes, tuple(ask.set))
    nodes, before = [], ()
    if find_layout(job.capture) is None:
        nodes, before = [Node(step("poses", capture))], ("poses",)
    masks: tuple[str, ...] = ()
    settings = asked.settings()
    # A box is given in the frame without masks, which masks may move: there the training makes them, and moves the box.
    if settings.image.masks == "auto" and not any(settings.region.size):
        nodes, masks = [*nodes, Node(step("masks", capture), before)], ("masks",)
    train = step(*asked.words(), made=run / "splats.ply")
    return [
        *nodes,
        Node(train, before, masks),
        Node(step("evaluate", str(run), made=run / "metrics.json"), ("train",)),
        Node(step("export", str(run), made=run / "mesh.glb"), ("train",), ("evaluate",)),
    ]
