"""Write pictures for the decision whether the scene needs a feature: a training view with the feature, and without it.

The pictures show the artist what such a decision (see `refgs.train.decide.needs`) is about. They are in the run folder, in `needs/`.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from refgs.compare.pictures import write_png
from refgs.formats.needs import Found, Pictures
from refgs.train import probe
from refgs.train.state import RenderInputs, State

PICTURES = "needs"  # in the run folder
SHOWN_SIDE = 320  # pixels of a picture's longer side: a panel shows no more

Pair = Callable[[State, Found, list[int]], Iterator[tuple[Tensor, Tensor]]]
"""Function that renders views with a part and without it: encoded pictures (H, W, 3). Its second argument is the recorded decision."""


@torch.no_grad()
def write_pictures(state: State, name: str, found: Found) -> Pictures | None:
    """Write three pictures of a view: rendered with an optional part of the training, rendered without this part, and the photo.

    `name` is the part's name in `refgs.train.decide.needs`, and `found` is the decision about it. The view is the one whose two renderings
    differ most. Returns the view's name, the pictures' paths in the run folder, and the PSNR of both renderings in dB. Returns None if no
    pictures were written.
    """
    if name not in PAIRS:
        return None
    views = probe.spread_views(state)
    most, chosen, pair = -1.0, -1, ()
    for view, (on, off) in zip(views, PAIRS[name](state, found, views), strict=False):  # yields all views or none
        on, off = on.clamp(0, 1), off.clamp(0, 1)
        if (apart := float((on - off).square().mean())) > most:
            most, chosen, pair = apart, view, (on, off)
    if not pair:
        return None
    photo = state.photo(chosen)
    truth = photo.over(state.background)
    written: dict[str, Any] = {"view": photo.camera.name}
    for kind, picture in zip(("on", "off", "photo"), (*pair, truth), strict=True):
        written[kind] = f"{PICTURES}/{name}_{kind}.png"
        write_png(state.folder / written[kind], _reduced(picture))
        if kind != "photo":
            written[f"psnr_{kind}"] = -10 * math.log10(max(float((picture - truth).square().mean()), 1e-12))
    return Pictures(**written)


def _reduced(picture: Tensor) -> np.ndarray:
    """Return an encoded picture as uint8, at most SHOWN_SIDE pixels on its longer side."""
    pixels = np.rint(255 * picture.numpy(force=True)).astype(np.uint8)
    scale = SHOWN_SIDE / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = [max(1, round(side * scale)) for side in pixels.shape[1::-1]]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _specular(state: State, found: Found, views: list[int]) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each view twice: with reflections, and with each surfel's mean reflection."""
    return probe.mirrored_and_mean(state, state.inputs(), views)


def _reflections(state: State, found: Found, views: list[int]) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each view twice: self-reflections show the object's mean radiance, then the environment's light."""
    # Only tracing would show what a mirror ray sees where it hits the object. These are two guesses.
    inputs = state.inputs()
    if inputs.occluder is None:
        return
    ways = probe.mirroring_itself(inputs, _mean_radiance(state, inputs, views)), inputs._replace(occluder=None)
    for view in views:
        yield probe.picture(state, view, ways[0]).color, probe.picture(state, view, ways[1]).color


def _mean_radiance(state: State, inputs: RenderInputs, views: list[int]) -> Tensor:
    """Average the linear radiance (3,) of the object's pixels over renderings of the views."""
    shown = (
        probe.picture(state, view, inputs).radiance[probe.on_object(state, inputs.surfels, view)] for view in views
    )
    return torch.stack([radiance.mean(dim=0) for radiance in shown if len(radiance)]).mean(dim=0)


def _light(state: State, found: Found, views: list[int]) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each view twice: with the full-resolution light, and with the reduced light."""
    inputs = state.inputs()
    if found.needed or inputs.settings.reflection == "none":
        return
    coarse = inputs._replace(environment=inputs.light.reduced(int(found.side or 0)))
    for view in views:
        yield probe.picture(state, view, inputs).color, probe.picture(state, view, coarse).color


PAIRS: dict[str, Pair] = {"specular": _specular, "reflections": _reflections, "light": _light}
"""Functions that render the pictures, by the need's name. Other needs have no pictures."""
