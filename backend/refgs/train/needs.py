"""What a scene needs of the method, and what it does without: each decision is a figure of the run's own beside a threshold.

`before` decides what is known before training, `weigh` the rest when enough of it is done, `reflections` when there is a mesh. Settings,
parameters and photos of the trainer are changed by what is left out, and nothing else looks at a decision. What a decision cost is the
PSNR of training views rendered with and without when it was made; what it saved are the seconds of an iteration with and without, times
the iterations that were left.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from refgs.model.prefilter import IRRADIANCE_SIDE
from refgs.model.surfels import Surfels
from refgs.train import probe
from refgs.train.probe import Way

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer

MARGIN = 10  # pixels about the mask: of D-SSIM's windows, whose radius is 5, none sees both the object and the border
WHOLE_EVERY = 8  # iterations: of these one sees all of its photo, so that nothing stays beyond the margin
LEAST_OUTSIDE = 0.1  # part of the pixels: what less takes could not be measured
# What moves by less than so many pixels, and differs by no more than 8-bit photos' noise, in decibels.
TWINS_PIXELS, TWINS_DECIBELS = 0.5, 40.0
KNOWN = 0.05  # part of the training after which it is known what mirrors: materials learn faster than shapes
SOONEST = 100  # iterations: a mirror of which less was learned looks dull
SEEN = 0.2  # opacity that surfels must have had the time to be back at: of what is faint all explains little
# Decibels. At a twentieth of a training matte clay has none; a polished plate has 0.8, glossy paint 2.6, a mirror 5.6.
LEAST_SPECULAR = 0.3
# Part of the iterations that are left, after which what mirrors nothing is as good as with everything after all: docs/measurements.md.
ENOUGH = 0.8
# Decibels between mirroring black and mirroring the light, which is more than what the object sends can be worth.
LEAST_REFLECTIONS = 0.1
SETTLED = 0.19  # part of the training after which roughness hardly changes; before the light has all its texels
GLOSSIEST = 0.05  # part of the picture that may be glossier than the roughness that texels are chosen for
LOBE = 0.5  # part of a lobe's width that a texel may take
LEAST_LIGHT = LEAST_DEGREES = 0.01  # dB
LEARNED = 0.7  # part of the time in which harmonics learn, after which it is known which degrees do
RARE = 1e-3  # part of the pictures, at either end, whose surfels do not count for what all have alike
CONSTANT = 1 / 255  # a spread that no 8-bit texture shows
REFLECTIONS = "indirect_dc", "indirect_rest", "received"
NUMBER = 4 * 4  # bytes: a float, its derivative and Adam's two moments
MEGA = 1e6


def _forced(trainer: "Trainer", name: str) -> str:
    return getattr(trainer.settings.needs, name)


def note(trainer: "Trainer", name: str, needed: bool, why: str, **figures: float) -> None:
    """Keep a decision: `statistic` and `threshold` that it was made by; what was saved, `seconds` and `megabytes`, zero where nothing is
    said; what it cost in `decibels`, where that could be measured."""
    trainer.needs[name] = {"needed": needed, "why": why, **{key: float(value) for key, value in figures.items()}}
    trainer.decide(name, f"{'with' if needed else 'without'} {WHAT[name]}: {why}")


WHAT = {
    "views": "all photos",
    "outside": "the pixels beyond the masks",
    "initial": "a first stage of surfels shaded one by one",
    "specular": "specular shading",
    "iterations": "all iterations",
    "reflections": "inter-reflection",
    "light": "all of the light's texels",
    "degrees": "all degrees of harmonics",
    "constants": "columns for metallic and roughness",
}
"""What a need is of, for the artist."""


def before(trainer: "Trainer") -> None:
    """Decide what is known from the photos alone, and what settings force."""
    settings = trainer.settings.render
    asked = "its setting leaves it out"
    if settings.reflection == "microfacet" and _forced(trainer, "specular") == "off":
        note(trainer, "specular", False, asked)
    if _forced(trainer, "reflections") == "off":
        note(trainer, "reflections", False, asked)
    if trainer.settings.initial.until > 0 and settings.shading == "deferred":
        # From the hull, deferred shading finds better normals alone than after it: docs/measurements.md, "What each part is worth".
        leave = {"auto": trainer.from_hull, "on": False, "off": True}[_forced(trainer, "initial")]
        if leave:
            why = asked if _forced(trainer, "initial") == "off" else "surfels start on the hull of the masks"
            note(trainer, "initial", False, why)
    for name in ("specular", "reflections", "initial"):
        apply(trainer, name)
    if _forced(trainer, "iterations") == "off" or "specular" in trainer.needs:
        _fewer_iterations(trainer, asked)
    _outside(trainer)


def twins(trainer: "Trainer") -> list[int]:
    """Training views that add nothing to others."""
    asked = _forced(trainer, "views")
    if asked == "on":
        return []
    found = probe.twins(trainer.views, trainer.capture.radius, TWINS_PIXELS, TWINS_DECIBELS)
    if found:
        size = sum(trainer.views[view].image.nbytes for view in found)
        why = f"{len(found)} of {len(trainer.views)} show what another shows, from less than {TWINS_PIXELS} pixels away"
        facts = {"statistic": len(found), "threshold": 1, "megabytes": size / MEGA}
        note(trainer, "views", False, why, **facts)
    return found


def _outside(trainer: "Trainer") -> None:
    asked = _forced(trainer, "outside")
    if asked == "on" or not trainer.from_hull or trainer.settings.loss.alpha == 0:
        return
    crops = [about(view.alpha, MARGIN) for view in trainer.views]
    within = sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in crops)
    part = 1 - within / sum(photo.image[..., 0].numel() for photo in trainer.photos)
    if asked == "auto" and part < LEAST_OUTSIDE:
        return
    trainer.crops = crops
    why = f"{part:.0%} of the photos' pixels lie more than {MARGIN} pixels beyond the masks' bounds; one photo in {WHOLE_EVERY} is whole"
    note(trainer, "outside", False, why, statistic=part, threshold=LEAST_OUTSIDE)


def about(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns of what a mask (H, W) shows, and so many pixels about that; all of them where it is empty."""
    shown = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        there = np.flatnonzero(mask.any(axis=axis)) if mask.any() else np.array([0, size - 1])
        shown.append(slice(max(int(there[0]) - margin, 0), min(int(there[-1]) + 1 + margin, size)))
    return tuple(shown)


def weigh(trainer: "Trainer", progress: float) -> None:
    """Decide what is due at this progress, 0..1, and leave out what the scene does without."""
    render = trainer.settings.render
    if trainer.initial or render.shading != "deferred" or render.diffuse != "irradiance" or trainer.faint(SEEN):
        return
    learned = progress - trainer.settings.initial.until  # what came before starts anew
    if trainer.crops is not None and trainer.iteration >= SOONEST and "seconds" not in trainer.needs["outside"]:
        trainer.needs["outside"]["seconds"] = (1 - 1 / WHOLE_EVERY) * probe.seconds_saved(trainer, whole=True)
    if (
        learned >= KNOWN
        and trainer.iteration >= SOONEST
        and _due(trainer, "specular")
        and render.reflection == "microfacet"
    ):
        _specular(trainer)
    if learned >= SETTLED and _due(trainer, "light"):
        _light(trainer)
    late = trainer.residual_start
    if late < 1 and progress >= late + LEARNED * (1 - late) and _due(trainer, "degrees"):
        _degrees(trainer)


def _due(trainer: "Trainer", name: str) -> bool:
    return name not in trainer.needs and _forced(trainer, name) != "on"


def _specular(trainer: "Trainer") -> None:
    explained = probe.specular_explains(trainer)
    why = f"what is mirrored explains {explained:.2f} dB of the photos beyond one colour a surfel"
    if explained >= LEAST_SPECULAR:
        note(trainer, "specular", True, why, statistic=explained, threshold=LEAST_SPECULAR)
        return
    saved = probe.seconds_saved(trainer, probe.without_specular)
    names = [name for name in ("metallic", "roughness", *REFLECTIONS) if name in trainer.parameters]
    size = sum(trainer.parameters[name].numel() for name in names) * NUMBER / MEGA
    facts = {"statistic": explained, "threshold": LEAST_SPECULAR, "seconds": saved, "megabytes": size}
    note(trainer, "specular", False, why, **facts, decibels=explained)
    one = trainer.seconds / trainer.iteration - saved / max(trainer.total - trainer.iteration, 1)
    apply(trainer, "specular")
    _fewer_iterations(
        trainer, "what mirrors nothing has less to learn", one, statistic=explained, threshold=LEAST_SPECULAR
    )


def _fewer_iterations(trainer: "Trainer", why: str, one: float = 0.0, **figures: float) -> None:
    """End sooner, unless a time was given to be used; `one` are the seconds of an iteration."""
    if "iterations" in trainer.needs or _forced(trainer, "iterations") == "on" or trainer.plan.minutes is not None:
        return
    total = trainer.iteration + round(ENOUGH * (trainer.total - trainer.iteration))
    facts = {"total": total, "seconds": max(one, 0.0) * (trainer.total - total)}
    note(trainer, "iterations", False, f"{why}: {total:,} in place of {trainer.total:,}", **figures, **facts)
    apply(trainer, "iterations")


@torch.no_grad()
def reflections(trainer: "Trainer", hidden: float) -> None:
    """Decide, a mesh having been made, by the part of the object's pixels in whose mirror direction the object itself stands."""
    asked, least = _forced(trainer, "reflections"), trainer.settings.indirect.least
    said = f"the object mirrors itself on {hidden:.1%} of it"
    if asked == "on" or trainer.needs.get("reflections", {}).get("needed"):
        trainer.decide("reflections", f"with {WHAT['reflections']}: {said}")
        return
    explained = probe.reflections_explain(trainer) if hidden >= least else 0.0
    why = said if hidden < least else f"{said}, where mirroring black would change the pictures by {explained:.2f} dB"
    facts = {"statistic": explained, "threshold": LEAST_REFLECTIONS}
    if hidden < least:
        facts = {"statistic": hidden, "threshold": least}
    needed = hidden >= least and explained >= LEAST_REFLECTIONS
    if not needed:
        with torch.enable_grad():
            facts["seconds"] = probe.seconds_saved(trainer, lambda way: way._replace(occluder=None))
        facts["decibels"] = probe.lost(trainer, lambda way: way._replace(occluder=None))
        names = [name for name in REFLECTIONS if name in trainer.parameters]
        facts["megabytes"] = sum(trainer.parameters[name].numel() for name in names) * NUMBER / MEGA
    note(trainer, "reflections", needed, why, **facts)
    apply(trainer, "reflections")


@torch.no_grad()
def _light(trainer: "Trainer") -> None:
    way, finest = trainer.way(), trainer.settings.environment.resolution
    coarsest = min(IRRADIANCE_SIDE, finest)
    if way.settings.reflection == "none":
        side, why = coarsest, f"nothing is mirrored: irradiance has {coarsest} texels along a side"
        figure = {}
    else:
        photos = [trainer.photo(view) for view in probe.views(trainer)]
        weight = probe.blended_shares(way.surfels, photos, trainer.near).sum(dim=0)
        roughness = probe.quantile(way.surfels.roughness, weight, GLOSSIEST)
        side = probe.resolvable(roughness, LOBE, finest, coarsest)
        why = f"{1 - GLOSSIEST:.0%} of the pictures are rougher than {roughness:.2f}, whose lobe {side} texels along a side show"
        figure = {"statistic": roughness, "threshold": math.sqrt(math.pi / 2 / (finest // 2) / LOBE)}
    if side >= finest:
        note(trainer, "light", True, why, **figure)
        return
    side = min(side, way.environment.resolution)

    def coarse(way: Way) -> Way:
        return way._replace(environment=probe.pooled(way.environment, side))

    lost = probe.lost(trainer, coarse)
    if lost > LEAST_LIGHT and _forced(trainer, "light") == "auto":
        note(trainer, "light", True, f"{why}, and yet the photos know {lost:.2f} dB of the finer ones", **figure)
        return
    with torch.enable_grad():
        saved = probe.seconds_saved(trainer, coarse)
    size = 6 * (finest**2 - side**2) * 3 * NUMBER / MEGA
    note(trainer, "light", False, why, **figure, side=side, seconds=saved, megabytes=size, decibels=lost)
    trainer.coarsen_light(side)
    apply(trainer, "light")


@torch.no_grad()
def _degrees(trainer: "Trainer") -> None:
    """The fewest degrees that lose next to nothing, of what is left over and of what the object sends itself."""
    facts, why = {"seconds": 0.0, "megabytes": 0.0, "decibels": 0.0}, []
    for field, name in (("sh_rest", "what is left over"), ("indirect_rest", "inter-reflection")):
        if field not in trainer.parameters:
            continue
        count = whole = trainer.parameters[field].shape[1]
        lost, errors = 0.0, probe.squares(trainer, trainer.way())
        for degree in reversed(range(math.isqrt(whole + 1) - 1)):

            def fewer(way: Way, field: str = field, count: int = (degree + 1) ** 2 - 1) -> Way:
                return way._replace(surfels=way.surfels._replace(**{field: getattr(way.surfels, field)[:, :count]}))

            worse = probe.decibels_lost(errors, probe.squares(trainer, fewer(trainer.way())))
            if worse > LEAST_DEGREES:
                break
            count, lost, shorter, last = (degree + 1) ** 2 - 1, worse, fewer, degree
        if count == whole:
            continue
        with torch.enable_grad():
            facts["seconds"] += probe.seconds_saved(trainer, shorter)
        numbers = len(trainer.parameters["position"]) * 3 * (whole - count)
        facts["megabytes"], facts["decibels"] = facts["megabytes"] + numbers * NUMBER / MEGA, facts["decibels"] + lost
        why.append(f"of {name} degree {last} is the last that is worth {LEAST_DEGREES} dB")
        trainer.shorten(field, count)
    note(
        trainer, "degrees", not why, "; ".join(why) or "the last degree is worth more", threshold=LEAST_DEGREES, **facts
    )


@torch.no_grad()
def constants(trainer: "Trainer", surfels: Surfels, kept: Tensor) -> dict[str, float]:
    """What all of the surfels kept (N,) have alike, as splats.ply says it: metallic, roughness, specular."""
    render = trainer.settings.render
    if render.reflection == "none" and render.shading != "sh":
        return {"metallic": 0.0, "roughness": 1.0, "specular": 0.0}
    if _forced(trainer, "constants") == "on" or render.shading == "sh":
        return {}
    photos = [trainer.photo(view) for view in probe.views(trainer)]
    weight = probe.blended_shares(surfels, photos, trainer.near).sum(dim=0) * kept
    found, spreads, forced = {}, [], _forced(trainer, "constants") == "off"
    for name in ("metallic", "roughness"):
        low, middle, high = (probe.quantile(getattr(surfels, name), weight, part) for part in (RARE, 0.5, 1 - RARE))
        if forced or high - low <= CONSTANT:
            found[name] = middle
            spreads.append(f"{name} is {middle:.3f}, within {high - low:.4f}")
    if found:

        def same(way: Way) -> Way:
            values = {name: torch.full_like(getattr(way.surfels, name), value) for name, value in found.items()}
            return way._replace(surfels=way.surfels._replace(**values))

        facts = {"statistic": len(found), "threshold": CONSTANT, "megabytes": 4 * len(found) * int(kept.sum()) / MEGA}
        note(trainer, "constants", False, "; ".join(spreads), **facts, decibels=probe.lost(trainer, same))
    return found


def apply(trainer: "Trainer", name: str) -> None:
    """Have the trainer do without what was found not to be needed; at once, and when a run is gone on with."""
    found, settings = trainer.needs.get(name), trainer.settings
    if found is None or found["needed"]:
        return
    if name == "specular":
        render = settings.render.model_copy(update={"reflection": "none"})
        trainer.settings = settings.model_copy(update={"render": render})
        trainer.occluder = None
        trainer.leave_out("metallic", "roughness", *REFLECTIONS)
    elif name == "reflections":
        trainer.occluder = None
        trainer.leave_out(*REFLECTIONS)
    elif name == "light":
        fewer = settings.environment.model_copy(update={"resolution": int(found["side"])})
        trainer.settings = settings.model_copy(update={"environment": fewer})
    elif name == "iterations":
        trainer.total = min(trainer.total, int(found["total"]))
    elif name == "initial":
        none = settings.initial.model_copy(update={"until": 0.0})
        trainer.settings, trainer.initial = settings.model_copy(update={"initial": none}), False


def facts(trainer: "Trainer") -> list[dict[str, Any]]:
    """The decisions, as needs.json lists them."""
    rows = []
    for name, found in trainer.needs.items():
        row = {"need": name, "what": WHAT[name], **found}
        if not found["needed"]:
            row["saved"] = f"{found.get('seconds', 0):.1f} s, {found.get('megabytes', 0):.1f} MB"
            row |= {"cost": f"{found['decibels']:+.3f} dB"} if "decibels" in found else {}
        rows.append(row)
    return rows
