"""A training that is given nothing but a time: its settings as far from `quick` to `standard`, and on, as fits into it."""

import math
from pathlib import Path

from refgs.capture import Capture
from refgs.settings import RATES, Settings, load_settings, validate
from refgs.train.plan import END, END_A_VIEW, OTHERS, Plan, growth, iterations_time
from refgs.train.trainer import Report, Trainer

WARM, REHEARSED = 5, 25  # iterations, from the first to the second of which the pace is taken
BY_PIXELS = 0.8  # an iteration's time grows as the photos' pixels do, to this power: 0.7 to 0.9 on three captures
SCHEDULE = ("train", "light_first"), ("densify", "every"), ("indirect", "every")  # they go with the iterations
FASTEST = 2.0  # times a preset's rates
STEPS, MOST = 64, 2.0  # in which settings are looked for from quick on, how far: standard is one


def fitting(capture: Capture, changes: list[str], folder: Path, plan: Plan, device: str, report: Report) -> Trainer:
    """What trains a capture into a run folder in the time of a `plan`. Between the presets, and as far beyond `standard`, every number
    goes by their ratio; with less time than `quick` takes, or more than that, there are fewer iterations or more.

    The pace is that of a rehearsal, some iterations by `quick`, which take a few seconds of the time. Where nothing but their number is
    to be another, these are the first ones.
    """
    quick, standard = (load_settings(preset, changes) for preset in ("quick", "standard"))
    begun, said = plan.spent, []
    trainer = Trainer(capture, quick, folder, lambda *event: said.append(event), plan, device)
    started = plan.spent
    marks = []
    for _ in range(REHEARSED):
        float(trainer.iterate()["loss"])  # a card is waited for
        marks.append(plan.spent)
    pace = (marks[-1] - marks[WARM - 1]) / (REHEARSED - WARM)
    views, first = len(capture.train_views) + len(capture.test_views), len(trainer.parameters["position"])
    pixels = _pixels(capture, quick)

    def iterations(settings: Settings) -> float:
        """How many of these fit."""
        larger = _pixels(capture, settings) / pixels
        start = (
            settings.surfels.start if first == quick.surfels.start else first
        )  # there may be fewer points to start from
        one = pace * (OTHERS + start) / (OTHERS + first) * larger**BY_PIXELS
        left = 60 * plan.minutes - plan.spent
        if settings is not quick:
            left -= (started - begun) * larger  # they have a start of their own
        more = growth(start, settings.surfels.budget)
        return (left / one - more * (END_A_VIEW * views + END)) / iterations_time(more, 1.0)

    found, count = quick, iterations(quick)
    for step in range(1, STEPS + 1):
        richer = between(quick, standard, MOST * step / STEPS)
        fit = iterations(richer)
        if fit < richer.train.iterations:
            break
        found, count = richer, fit
    if found is quick:
        trainer.report = report
        for event in said:
            report(*event)
        trainer.settings = _scheduled(trainer.settings, max(count, 1.0) + REHEARSED, quick.train.iterations)
        trainer.total = trainer.settings.train.iterations
    else:
        del trainer  # before there is another, for its memory
        settings = _scheduled(found, count, min(count, standard.train.iterations))
        trainer = Trainer(capture, settings, folder, report, plan, device)
    settings = trainer.settings
    found = f"{settings.train.iterations:,} iterations, {settings.surfels.budget:,} surfels at most"
    what = f"planned for {plan.minutes:g} minutes: about {found}, photos of {settings.image.max_side} pixels at most"
    report("stage", {"what": what})
    return trainer


def between(quick: Settings, standard: Settings, part: float) -> Settings:
    """Settings so much of the way from the one to the other, or beyond; the light's texels, a power of two along a side, the fewer."""
    tables, ends = quick.model_dump(), standard.model_dump()
    for section, values in tables.items():
        for name, value in values.items():
            if value != ends[section][name]:
                values[name] = round(value * (ends[section][name] / value) ** part)
    texels = tables["environment"]
    texels["resolution"] = 2 ** int(math.log2(texels["resolution"]))
    return validate(tables, "a time")


def _scheduled(settings: Settings, iterations: float, usual: float) -> Settings:
    """So many iterations, and what is done at some of them as much apart. With more than are `usual`, or fewer, rates go by the inverse
    root of how many: what is chance in all those steps, each of one view, then adds up to as much."""
    tables, part = settings.model_dump(), iterations / settings.train.iterations
    for section, name in (("train", "iterations"), *SCHEDULE):
        tables[section][name] = max(1, round(part * tables[section][name]))
    for name in RATES:
        tables["rates"][name] *= min((usual / iterations) ** 0.5, FASTEST)
    return validate(tables, "a time")


def _pixels(capture: Capture, settings: Settings) -> int:
    cameras = [view.camera.fitted(settings.image.max_side) for view in capture.train_views]
    return sum(camera.width * camera.height for camera in cameras)
