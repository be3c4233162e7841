"""What a picture loses without a part of the method, and what an iteration takes: figures of a training, by which `needs` decides.

They are of training views, as they are when it is asked; decibels are of the mean squared error over all that are looked at.
"""

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from refgs.capture import LoadedView
from refgs.color import srgb_encode
from refgs.compare.metrics import psnr
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.renderer import COVERED, Rendering, render
from refgs.render.volume import discs
from refgs.settings import RenderSettings
from refgs.train.losses import Photo, objective

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer

VIEWS = 8  # that are looked at, at the most
SEVERAL = 12  # where a surfel has to be seen from several sides
REPEATS = 2  # iterations that are timed with and without; the fastest of each counts


class Way(NamedTuple):
    """What a picture is made from."""

    surfels: Surfels
    environment: Environment | None
    settings: RenderSettings
    occluder: Occluder | None


Change = Callable[[Way], Way]


def pooled(environment: Environment, side: int) -> Environment:
    """The light with so many texels along a side, means of the finer ones."""
    fine = environment.resolution // side
    texels = environment.radiance.reshape(6, side, fine, side, fine, 3).mean(dim=(2, 4))
    return Environment(texels.reshape(-1, 3), environment.reference)


def without_specular(way: Way) -> Way:
    """Matte."""
    return way._replace(settings=way.settings.model_copy(update={"reflection": "none"}), occluder=None)


def picture(trainer: "Trainer", view: int, way: Way, whole: bool = False) -> Rendering:
    """What training looks at of a view, or all of it, rendered that way."""
    place = trainer.background, way.settings, trainer.near, way.occluder, trainer.exposure(view)
    return render(way.surfels, way.environment, trainer.photo(view, whole).camera, *place)


def square(rendering: Tensor, photo: Photo, background: Tensor) -> float:
    """Mean squared error of an encoded picture (H, W, 3) against a photo over the background."""
    image = photo.image.float() / 255
    if photo.mask is not None:
        opaque = photo.mask.float()[..., None] / 255
        image = image * opaque + background * (1 - opaque)
    return float((rendering.clamp(0, 1) - image).square().mean())


def decibels_lost(errors: list[float], without: list[float]) -> float:
    """By how much the PSNR falls from mean squared errors to others."""
    return 10 * math.log10(max(sum(without), 1e-12) / max(sum(errors), 1e-12))


def views(trainer: "Trainer", most: int = VIEWS) -> list[int]:
    """Training views spread over all of them."""
    return list(range(len(trainer.photos)))[:: max(1, len(trainer.photos) // most)][:most]


@torch.no_grad()
def squares(trainer: "Trainer", way: Way) -> list[float]:
    """Mean squared errors of training views that are rendered that way."""
    found = []
    for view in views(trainer):
        found.append(square(picture(trainer, view, way).color, trainer.photo(view), trainer.background))
    return found


@torch.no_grad()
def lost(trainer: "Trainer", change: Change) -> float:
    """What pictures of training views lose by a change, in dB."""
    way = trainer.way()
    return decibels_lost(squares(trainer, way), squares(trainer, change(way)))


def seconds_saved(trainer: "Trainer", change: Change = lambda way: way, whole: bool = False) -> float:
    """Of the iterations that are left, by an iteration without and with a change; or with the `whole` photo and with the part that training
    looks at. The optimiser's step is in neither."""
    fastest = [math.inf, math.inf]
    for _ in range(REPEATS):
        for which, (how, all_of_it) in enumerate(((lambda way: way, whole), (change, False))):
            begun = time.perf_counter()
            rendering = picture(trainer, 0, how(trainer.way()), all_of_it)
            photo = trainer.photo(0, all_of_it)
            loss, _ = objective(rendering, None, photo, trainer.background, trainer.losses, 1.0)
            loss.backward()
            if trainer.device.type == "cuda":
                torch.cuda.synchronize()
            fastest[which] = min(fastest[which], time.perf_counter() - begun)
            trainer.forget_gradients()
    return max(fastest[0] - fastest[1], 0.0) * max(trainer.total - trainer.iteration, 0)


@torch.no_grad()
def blended_shares(surfels: Surfels, photos: list[Photo], near: float, maps: list[Tensor] | None = None) -> Tensor:
    """Of each surfel and photo how many pixels of the picture are it (V, N); or, of maps (H, W, C) of the photos, their mean over all
    pixels by that weight (N, C): the gradient of a sum of constant features."""
    surfels, count, rows = Surfels(*(value.detach() for value in surfels)), len(surfels.positions), []
    width = 1 if maps is None else maps[0].shape[-1] + 1
    for number, photo in enumerate(photos):
        feature = torch.ones(count, width, device=surfels.positions.device, requires_grad=True)
        with torch.enable_grad():
            blended = rasterize(*discs(surfels, photo.camera), feature, photo.camera, near=near).features
            if maps is not None:
                blended = blended * torch.cat([maps[number], torch.ones_like(blended[..., :1])], dim=-1)
            blended.sum().backward()  # for a gradient that is given, torch would load sympy: half a second
        rows.append(feature.grad if maps is not None else feature.grad[:, 0])
    if maps is None:
        return torch.stack(rows)
    total = torch.stack(rows).sum(dim=0)
    return total[:, :-1] / total[:, -1:].clamp_min(1e-6)


@torch.no_grad()
def specular_explains(trainer: "Trainer") -> float:
    """In dB, what the specular part explains of training views beyond a colour of each surfel that is the same from everywhere: each
    surfel's mean of that part, by its weight in the pixels, takes its place. A matte surface learns as much by its albedo."""
    way, some = trainer.way(), views(trainer, SEVERAL)
    photos, dull = [trainer.photo(view) for view in some], without_specular(way)
    shown, matte = ([picture(trainer, view, how) for view in some] for how in (way, dull))
    over = [a.radiance - b.radiance for a, b in zip(shown, matte, strict=True)]
    mean = blended_shares(way.surfels, photos, trainer.near, over)
    display, errors = way.settings.color_space == "display", ([], [])
    for photo, rendering, base in zip(photos, shown, matte, strict=True):
        feature = rasterize(*discs(way.surfels, photo.camera), mean, photo.camera, near=trainer.near).features
        alpha = rendering.alpha[..., None]
        radiance = base.radiance + feature / alpha.clamp_min(COVERED)
        exposed = radiance if rendering.exposure is None else radiance * rendering.exposure
        encoded = exposed if display else srgb_encode(exposed)
        flat = torch.where(alpha > COVERED, encoded * alpha, 0) + (1 - alpha) * trainer.background
        for found, image in zip(errors, (rendering.color, flat), strict=True):
            found.append(square(image, photo, trainer.background))
    return decibels_lost(*errors)


@torch.no_grad()
def reflections_explain(trainer: "Trainer") -> float:
    """In dB, how far pictures in which the object mirrors nothing but black of itself are from those in which it mirrors the light
    there, by what is wrong with the pictures today: more than that nobody can win by what it really mirrors."""
    way, wrong, apart = trainer.way(), 0.0, 0.0
    black = way.surfels._replace(
        indirect_dc=torch.zeros_like(way.surfels.indirect_dc),
        indirect_rest=torch.zeros_like(way.surfels.indirect_rest),
        received=torch.ones_like(way.surfels.received),
    )
    for view in views(trainer):
        free = picture(trainer, view, way._replace(occluder=None)).color
        hidden = picture(trainer, view, way._replace(surfels=black)).color
        wrong += square(free, trainer.photo(view), trainer.background)
        apart += float((free.clamp(0, 1) - hidden.clamp(0, 1)).square().mean())
    return 10 * math.log10(1 + apart / max(wrong, 1e-12))


@torch.no_grad()
def quantile(values: Tensor, weight: Tensor, part: float) -> float:
    """The value (N,) below which this part of the weight (N,) is."""
    order = values.argsort()
    share = weight[order].cumsum(dim=0) / weight.sum().clamp_min(1e-9)
    return float(values[order][int((share < part).sum().clamp_max(len(order) - 1))])


def resolvable(roughness: float, part: float, finest: int, coarsest: int) -> int:
    """Texels along a side of the cubemap, `finest` at the most and `coarsest` at the least: the fewest that take no more than this part of
    what that roughness's lobe is wide, its square in radians."""
    side = coarsest
    while side < finest and math.pi / 2 / side > part * roughness**2:
        side *= 2
    return side


def twins(views: list[LoadedView], radius: float, pixels: float, decibels: float) -> list[int]:
    """Which of the views add nothing to an earlier one: taken from where that was, so that no point of the object moves by as much as
    this in the picture, and showing the same but for so much noise."""
    found, kept = [], []
    for number, view in enumerate(views):
        alike = any(
            moved(views[other], view, radius) < pixels and _agree(views[other], view) > decibels for other in kept
        )
        (found if alike else kept).append(number)
    return found


def moved(one: LoadedView, other: LoadedView, radius: float) -> float:
    """How far a point of the object moves from one photo to the other, in pixels, at the most; infinite between photos of two sizes."""
    a, b = one.camera, other.camera
    if (a.width, a.height) != (b.width, b.height) or (one.alpha is None) != (other.alpha is None):
        return math.inf
    apart = float(np.linalg.norm(a.position - b.position)) / max(
        float(np.linalg.norm(a.position)) - radius, 0.1 * radius
    )
    turned = float(np.linalg.norm(a.world_to_camera[:3, :3] - b.world_to_camera[:3, :3]))
    lens = abs(a.fx - b.fx) + abs(a.fy - b.fy) + abs(a.cx - b.cx) + abs(a.cy - b.cy)
    return (apart + turned) * max(a.fx, a.fy) + lens


def _agree(one: LoadedView, other: LoadedView) -> float:
    """PSNR in dB between two photos of the same size."""
    return psnr(one.image / np.float32(255), other.image / np.float32(255))
