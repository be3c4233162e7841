"""Measure how much worse pictures get, and how much faster an iteration gets, if a part of the training is left out.

`decide.needs` uses these measurements for its decisions. They are made on training views, with the surfels and the light as they are
now, and only on pixels that show the object. PSNR is computed from the mean squared error over these pixels of all measured views.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.model.harmonics import DC
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.rendering import COVERED, Rendering
from refgs.render.sums import blended_shares
from refgs.render.volume import discs
from refgs.spread import spread
from refgs.train.learn.coarse import cost
from refgs.train.learn.exposures import exposure
from refgs.train.learn.losses import objective
from refgs.train.state import RenderInputs, State

VIEWS = 8  # views that are looked at, at most
SEVERAL = 12  # views, at most, where a surfel must be seen from several sides
PART = 0.01  # fraction of the object's pixels that is judged by itself: a chrome bell may be no larger
REPEATS = 2  # times that each kind of iteration is measured; the fastest counts

Change = Callable[[RenderInputs], RenderInputs]
"""Function that leaves a part out of the inputs of a rendering."""


def without_specular(inputs: RenderInputs) -> RenderInputs:
    """Return a copy of `inputs` with which all surfaces are rendered as matte."""
    return inputs._replace(settings=inputs.settings.model_copy(update={"reflection": "none"}), occluder=None)


def picture(state: State, view: int, inputs: RenderInputs, whole: bool = False) -> Rendering:
    """Render a training view: the crop that the training uses, or the `whole` view."""
    return state.picture(inputs, state.photo(view, whole).camera, exposure(state, view))


class Lost(NamedTuple):
    """Hold how many dB of PSNR the training views lose by a change of what is rendered, such as leaving out reflections.

    `whole` is the loss over all of the object's pixels. `part` is the loss over the fraction PART of these pixels that changes most,
    because a small part of the object may need a feature that most of it does not.
    """

    whole: float
    part: float


def decibels_lost(errors: Tensor, without: Tensor) -> float:
    """Compute by how many dB the PSNR falls from squared errors `errors` to `without`."""
    return 10 * math.log10(max(float(without.sum()), 1e-12) / max(float(errors.sum()), 1e-12))


def lost(views: Iterable[tuple[Tensor, Tensor, Tensor]]) -> Lost:
    """Compute how many dB of PSNR are lost from the first to the second of two pictures of each view.

    Each of `views` is (picture, changed picture, photo): the object's sRGB-encoded pixels in them, (P, 3) each. The pixels of `Lost.part`
    are those in which the two pictures differ most. The photo is not used to choose them, so that its noise favours neither picture.
    `views` may be a generator: only three numbers per pixel are kept.
    """
    rows = []
    for picture, other, truth in views:
        picture, other = picture.clamp(0, 1), other.clamp(0, 1)
        rows.append([(a - b).square().mean(dim=1) for a, b in ((picture, truth), (other, truth), (picture, other))])
    errors, without, apart = (torch.cat(values) for values in zip(*rows, strict=True))
    most = apart.topk(math.ceil(PART * len(apart))).indices
    return Lost(decibels_lost(errors, without), decibels_lost(errors[most], without[most]))


def spread_views(state: State, most: int = VIEWS) -> list[int]:
    """Return the indices of at most `most` training views, evenly spaced."""
    return spread(range(len(state.photos)), most)


def random_views(state: State, seed: int, most: int) -> list[int]:
    """Return the indices of at most `most` training views. Each `seed` chooses others."""
    return torch.randperm(len(state.views), generator=torch.Generator().manual_seed(seed))[:most].tolist()


@torch.no_grad()
def on_object(state: State, surfels: Surfels, view: int) -> Tensor:
    """Tell which pixels (H, W) of a training view's crop show the object: those in the mask and in the region to train.

    If there is neither a mask nor a region, all pixels show the object.
    """
    photo = state.photo(view)
    shown = torch.ones(photo.image.shape[:2], dtype=torch.bool, device=state.device)
    if photo.mask is not None:
        shown &= photo.mask > 127
    if state.capture.box is not None:
        wanted = state.wanted().float()[:, None]
        shown &= rasterize(*discs(surfels, photo.camera), wanted, photo.camera, near=state.near).features[..., 0] > 0.5
    return shown


@torch.no_grad()
def psnr_loss(state: State, change: Change, inputs: RenderInputs | None = None) -> Lost:
    """Compute how many dB of PSNR the training views lose by a change of what is rendered.

    `change` is a function that takes the inputs of a rendering and returns the changed inputs. `inputs` are the state's if not given.
    """
    inputs = state.inputs() if inputs is None else inputs
    ways = inputs, change(inputs)
    views = spread_views(state)
    pairs = ([picture(state, view, way).color for way in ways] for view in views)
    return lost(_on_object(state, inputs, views, pairs))


def _on_object(
    state: State, inputs: RenderInputs, views: list[int], pairs: Iterable[Sequence[Tensor]]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield the object's pixels (P, 3) of each view, in both pictures and the photo."""
    for view, (one, other) in zip(views, pairs, strict=True):
        shown = on_object(state, inputs.surfels, view)
        yield one[shown], other[shown], state.photo(view).over(state.background)[shown]


@torch.enable_grad()
def seconds_saved(state: State, change: Change = lambda inputs: inputs, whole: bool = False) -> float:
    """Measure how many seconds a change of what is rendered would save in all remaining iterations.

    Time two iterations on photos of full size: one without the change, and one with it. The optimiser's step is not timed. Both render only
    the crop of the photo that the training uses. But if `whole` is true, the iteration without the change renders the whole photo, so that
    the result includes what cropping saves. Remaining iterations on reduced photos are counted as shorter.
    """
    fastest = [math.inf, math.inf]
    for _ in range(REPEATS):
        for which, (how, all_of_it) in enumerate(((lambda inputs: inputs, whole), (change, False))):
            begun = time.perf_counter()
            rendering = picture(state, 0, how(state.inputs()), all_of_it)
            loss, _ = objective(rendering, None, state.photo(0, all_of_it), state.background, state.losses, 1.0)
            loss.backward()
            if state.device.type == "cuda":
                torch.cuda.synchronize()
            fastest[which] = min(fastest[which], time.perf_counter() - begun)
            state.learned.forget_gradients()
    return max(fastest[0] - fastest[1], 0.0) * max(cost(state, state.iteration, state.total), 0.0)


def mirrored_and_mean(state: State, inputs: RenderInputs, views: list[int]) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield two sRGB-encoded pictures (H, W, 3) of each view: with reflections, and with reflections that do not change with the view.

    In the second picture, each surfel's specular colour is its mean over the `views`, which a matte surface could learn as albedo. Call
    this function under `torch.no_grad()`.
    """
    dull = without_specular(inputs)
    over = (picture(state, view, inputs).radiance - picture(state, view, dull).radiance for view in views)
    mean = blended_shares(inputs.surfels, (state.photo(view).camera for view in views), state.near, over)
    for view in views:
        shown, base, camera = picture(state, view, inputs), picture(state, view, dull), state.photo(view).camera
        feature = rasterize(*discs(inputs.surfels, camera), mean, camera, near=state.near).features
        alpha = shown.alpha[..., None]
        radiance = base.radiance + feature / alpha.clamp_min(COVERED)
        encoded = state.method.light.encode(radiance if shown.exposure is None else radiance * shown.exposure)
        yield shown.color, torch.where(alpha > COVERED, encoded * alpha, 0) + (1 - alpha) * state.background


@torch.no_grad()
def specular_explains(state: State) -> Lost:
    """Compute how many dB of PSNR the training views lose if reflections no longer change with the view.

    Matte shading cannot make up for this loss, because each surfel's mean reflection is kept (see `mirrored_and_mean`).
    """
    inputs, some = state.inputs(), spread_views(state, SEVERAL)
    return lost(_on_object(state, inputs, some, mirrored_and_mean(state, inputs, some)))


def mirroring_itself(inputs: RenderInputs, radiance: Tensor) -> RenderInputs:
    """Return a copy of `inputs` in which all inter-reflected light is the constant linear `radiance` (3,).

    A mirror ray that hits the object then returns this radiance instead of the environment's light.
    """
    surfels = inputs.surfels
    constant = surfels._replace(
        indirect_dc=(radiance / DC).expand_as(surfels.indirect_dc),
        indirect_rest=torch.zeros_like(surfels.indirect_rest),
        received=torch.ones_like(surfels.received),
    )
    return inputs._replace(surfels=constant)


@torch.no_grad()
def reflections_explain(state: State) -> Lost:
    """Estimate how many dB of PSNR the training views can gain from inter-reflection at most.

    Two pictures are compared. Where the object mirrors itself, one picture shows black, and the other shows the environment's light.
    The correct picture lies between the two, so the gain is at most their difference. The result is how many dB the PSNR falls if this
    difference is added to the error against the photos.
    """
    inputs, wrong, apart = state.inputs(), [], []
    black = mirroring_itself(inputs, torch.zeros(3, device=state.device))
    for view in spread_views(state):
        shown = on_object(state, inputs.surfels, view)
        free = picture(state, view, inputs._replace(occluder=None)).color[shown].clamp(0, 1)
        hidden = picture(state, view, black).color[shown].clamp(0, 1)
        wrong.append((free - state.photo(view).over(state.background)[shown]).square().mean(dim=1))
        apart.append((free - hidden).square().mean(dim=1))
    errors, more = torch.cat(wrong), torch.cat(apart)
    most = more.topk(math.ceil(PART * len(more))).indices
    return Lost(decibels_lost(errors, errors + more), decibels_lost(errors[most], (errors + more)[most]))


@torch.no_grad()
def quantile(values: Tensor, weight: Tensor, part: float) -> float:
    """Return the weighted quantile of `values` (N,) at the fraction `part` of the weight."""
    order = values.argsort()
    share = weight[order].cumsum(dim=0) / weight.sum().clamp_min(1e-9)
    return float(values[order][int((share < part).sum().clamp_max(len(order) - 1))])
