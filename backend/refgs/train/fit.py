"""Choose the settings of a training that must end within a given time. They range from the preset `quick` to beyond `standard`."""

import math
from itertools import pairwise
from pathlib import Path
from statistics import median

from refgs.capture import Capture
from refgs.effective import Effective
from refgs.events import Report
from refgs.settings import RATES, Settings, validate
from refgs.train.decide.object_size import object_size, surfel_limits
from refgs.train.learn import coarse
from refgs.train.learn.poses import Poses
from refgs.train.plan import FULL, OTHERS, PART, STARTS, Plan, by_pixels, growth, iterations_time
from refgs.train.timeline import DIVIDE_COST, MESH_COST
from refgs.train.trainer import Trainer

WARM, REHEARSED = 5, 25  # iterations between which the pace is measured
REHEARSAL = 0.03  # of the time given, after which fewer iterations are enough
# Settings that are scaled with the iterations, and the fewest iterations to which they are reduced.
SCHEDULE = (
    ("train", "light_first", 1),
    ("densify", "every", DIVIDE_COST / PART),
    ("indirect", "every", MESH_COST / PART),
)
FASTEST = 2.0  # largest factor on a preset's learning rates
RICHER_STEPS, RICHEST = 64, 2.0  # number of steps from `quick` (0) to the richest settings; `standard` is at 1


def fitting(
    capture: Capture, effective: Effective, standard: Settings, folder: Path, plan: Plan, device: str, report: Report
) -> Trainer:
    """Make a trainer whose settings let the training end within `plan.minutes`.

    First, run a few iterations with the preset `quick` to measure how long an iteration takes. If there is little time, they start with
    less detail: the time since the command started tells how fast the machine is now. Then try settings from `quick` to beyond
    `standard` (see `between`), and choose the most detailed ones whose iterations all fit. If none fit, choose `quick`. Finally, set
    the number of iterations to as many as fit.

    If `quick` is chosen, the training continues after the measured iterations. Otherwise it starts anew. `effective` holds the settings of
    the preset `quick`, and `standard` those of the preset `standard`. Both include the user's changes.
    """
    why, begun, said = f"{plan.minutes:g} minutes were given", plan.spent, []
    detail = plan.lower_detail(STARTS * plan.given / plan.spent)
    effective = effective.moved_to(_with_detail(effective.settings, detail), "plan", why)
    quick = effective.settings
    trainer = Trainer(capture, effective, folder, lambda *event: said.append(event), plan, device)
    started = plan.spent
    marks = []
    while len(marks) <= WARM or (len(marks) < REHEARSED and plan.spent - marks[WARM - 1] < REHEARSAL * plan.given):
        float(trainer.iterate()["loss"])  # reading the loss waits for the graphics card
        marks.append(plan.spent)
    cost = trainer.state.part(coarse.Coarse).stages[0].cost
    # Seconds of an iteration on full photos. The median, because some of the first iterations wait for what is loaded only once.
    pace = median(after - before for before, after in pairwise(marks[WARM - 1 :])) / cost
    views, first = len(capture.train_views) + len(capture.test_views), trainer.state.learned.count
    pixels, size = _pixels(capture, quick), object_size(trainer.state)

    def iterations(settings: Settings) -> float:
        """Estimate how many iterations with these settings fit into the time that is left."""
        larger = _pixels(capture, settings) / pixels
        asked, budget = surfel_limits(settings.surfels, size.area * larger)
        # Fewer points may be known to start from than the settings ask for.
        start = asked if first == trainer.state.settings.surfels.start else first
        one = pace * (OTHERS + start) / (OTHERS + first) * by_pixels(size.span**2 or pixels / views, larger)
        left = plan.given - plan.spent
        if settings is not quick:
            left -= (started - begun) * larger  # richer settings need a second start
        more = growth(start, budget)
        stages = FULL if settings.image.coarse == "off" else coarse.stages(size.span * larger**0.5, detail)
        return (left / one - more * plan.end(views, one * more)) / iterations_time(more, 1.0, stages)

    plan.pace = pace
    found, count = quick, iterations(quick)
    for step in range(1, RICHER_STEPS + 1):
        richer = between(quick, standard, RICHEST * step / RICHER_STEPS)
        fit = iterations(richer)
        if fit < richer.train.iterations:
            break
        found, count = richer, fit
    if found is quick:
        state = trainer.state
        state.report = report
        plan.lower_detail((count / quick.train.iterations) ** 0.5 if count > 0 else 0.0)
        coarse.begin(state, size.span, refined=state.part(Poses).values is not None)
        for event in said:
            report(*event)
        settings = _scheduled(state.settings, max(count, 1.0) + len(marks), quick, standard)
        state.effective = state.effective.moved_to(settings, "plan", why)
        state.total = settings.train.iterations
    else:
        del trainer  # free its memory first
        settings = _scheduled(found, count, quick, standard)
        trainer = Trainer(capture, effective.moved_to(settings, "plan", why), folder, report, plan, device)
    settings = trainer.state.settings
    found = f"{settings.train.iterations:,} iterations, {settings.surfels.budget:,} surfels at most"
    what = f"planned for {plan.minutes:g} minutes: about {found}, photos of {settings.image.max_side} pixels at most"
    report("stage", {"what": what, "detail": True})
    return trainer


def between(quick: Settings, standard: Settings, part: float) -> Settings:
    """Interpolate geometrically between two presets: `part` 0 gives `quick`, 1 gives `standard`, and more than 1 extrapolates.

    The side of the light's cubemap is rounded down to a power of two.
    """
    tables, ends = quick.model_dump(), standard.model_dump()
    for section, values in tables.items():
        for name, value in values.items():
            if value != ends[section][name]:
                values[name] = round(value * (ends[section][name] / value) ** part)
    texels = tables["environment"]
    texels["resolution"] = 2 ** int(math.log2(texels["resolution"]))
    return validate(tables, "a time")


def _with_detail(settings: Settings, detail: float) -> Settings:
    """Multiply the number of surfels to start with by `detail`, and the number of voxels of the visual hull by its square."""
    tables = settings.model_dump()
    surfels = tables["surfels"]
    surfels |= {"start": round(detail * surfels["start"]), "hull": round(detail ** (2 / 3) * surfels["hull"])}
    return validate(tables, "a time")


def _scheduled(settings: Settings, iterations: float, quick: Settings, standard: Settings) -> Settings:
    """Set the number of iterations, and adapt the schedule and the learning rates to it."""
    # Each step adds noise, because it uses one view. Outside of the range from `quick` to `standard`, rates are multiplied by √(n /
    # iterations), n the nearer of the two and the factor at most FASTEST, so that the noise of all steps together stays about the same.
    tables, part = settings.model_dump(), iterations / settings.train.iterations
    usual = min(max(iterations, quick.train.iterations), standard.train.iterations)
    for section, name, least in (("train", "iterations", 1), *SCHEDULE):
        now = tables[section][name]
        tables[section][name] = round(max(part * now, min(least, now)))
    for name in RATES:
        tables["rates"][name] *= min((usual / iterations) ** 0.5, FASTEST)
    return validate(tables, "a time")


def _pixels(capture: Capture, settings: Settings) -> int:
    cameras = [view.camera.fitted(settings.image.max_side) for view in capture.train_views]
    return sum(camera.width * camera.height for camera in cameras)
