"""Use priors early in the training: normals and depth that other programs guessed from single photos.

Photos of mirrors and hollow shapes can also be explained by wrong shapes: the visual hull closes a bowl with a lid, for example. A network
that guesses from one photo knows what bowls look like. Its guess is wrong in detail, and its depth has no scale. So the loss terms of
priors saturate, and fade to zero: in the end, only the photos count.

Programs write normals with different axes. The axes that agree best with the surfels at the start are used for all views. Depth is fitted
to the rendered depth each time that it is used, with one scale and one shift per view.
"""

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.capture import load_depth, load_normals
from refgs.capture.poses import split_similarity
from refgs.render.rendering import SOLID, Rendering
from refgs.spread import spread
from refgs.train.part import Part
from refgs.train.photo import Photo
from refgs.train.state import State
from refgs.train.timeline import Step

FADED = 0.6  # part of the training after which priors have no weight
PRIOR_VIEWS = 16  # views that are looked at, at most, to find out what the files mean
OUTLINE = 80  # a pixel is near an outline within this part of the photo's longer side: 1/80
# Least correlation with the outlines' shape; near outlines, normals of a bowl have 0.58, with 15° of noise 0.48, others 0.32.
AGREES = 0.35
WRONG = 0.5  # 1 − cosine at which a guessed normal is as likely wrong as the surface: its pull is a quarter there
FAR = 0.1  # scene radii of distance at which a guessed depth is as likely wrong as the surface
ROUNDS = 3  # rounds of reweighting in the fit of depth
CODE = 127  # code of the component 1 in a map of normals


Maps = dict[int, tuple[Tensor, Camera]]
"""Guesses by the view's index: a map, and the photo's camera in the map's size."""


class Priors(Part):
    """Hold the normal and depth priors of the training views, which other programs estimated from the photos.

    `normals` and `depth` are dicts by the view's index. Each entry is a map, and the photo's camera in the size of this map. Maps of
    normals are int8 (H, W, 3): unit vectors in the camera's axes, times CODE. Maps of depth are float32 (H, W) with unknown scale and
    shift. If `disparity` is true, all maps of depth hold disparities. A value of 0 means unknown.
    """

    name = "priors"
    disparity = False

    def start(self, state: State) -> None:
        self.normals: Maps = {}
        self.depth: Maps = {}


def load(state: State) -> None:
    """Load the priors of the training views, and find out what they mean: the axes of normals, and whether depth is a disparity.

    Priors are used only if all photos have masks. Without masks, there is no shape to compare the priors with.
    """
    given = {view.camera.name: view for view in state.capture.train_views if view.prior_normals or view.prior_depth}
    if state.settings.loss.prior == 0 or not given:
        return
    if not state.from_hull:
        state.announce("priors", "without normals or depth from elsewhere: not every photo has a mask of the object")
        return
    with state.clock.part("start"):
        normals, depth = {}, {}
        for index, view in enumerate(state.views):
            if (files := given.get(view.camera.name)) is None:
                continue
            if (prior := load_normals(files)) is not None:
                codes = torch.from_numpy(np.rint(CODE * prior.values).astype(np.int8))
                normals[index] = codes.to(state.device), prior.camera
            if (prior := load_depth(files)) is not None:
                depth[index] = torch.from_numpy(prior.values).to(state.device), prior.camera
        found = state.part(Priors)
        found.normals = _with_axes(state, normals)
        found.depth, found.disparity = _with_kind(state, depth)


def loss(state: State, step: Step) -> Tensor | None:
    """Compute the loss of the priors of this step's view. Return None if the view has no priors, or if priors have faded to zero.

    The loss is a scalar: a mean over the pixels of the whole photo, also if only a crop is rendered.
    """
    view, rendering, photo = step.view, step.rendering, step.photo
    weight, priors = state.settings.loss.prior * fade(step.progress), state.part(Priors)
    terms = []
    if weight > 0 and view in priors.normals:
        terms.append(normals_loss(rendering, photo, *priors.normals[view]))
    if weight > 0 and view in priors.depth:
        terms.append(depth_loss(rendering, photo, *priors.depth[view], priors.disparity, state.capture.radius))
    return weight * torch.stack(terms).sum() if terms else None


def fade(progress: float) -> float:
    """Return the factor on priors' weights, which falls from 1 to 0 at progress FADED."""
    return 0.5 + 0.5 * math.cos(math.pi * min(progress / FADED, 1.0))


def normals_loss(rendering: Rendering, photo: Photo, codes: Tensor, camera: Camera) -> Tensor:
    """Compute how far rendered normals are from guessed ones: a scalar.

    `codes` (H, W, 3) int8 are unit vectors times CODE in the axes of a camera (x right, y down, z forward), 0 where not known. `camera` is
    the photo's camera in the size of `codes`. The loss of a pixel saturates: it is e / (e + WRONG), where e is 1 − the cosine.
    """
    guessed = at_pixels(codes, camera, photo.camera).to(rendering.normal) / CODE
    counts = _counts(rendering, photo) * (guessed.square().sum(dim=-1) > 0.5)
    turn = torch.from_numpy(photo.camera.world_to_camera[:3, :3].copy()).to(guessed)
    cosine = torch.nn.functional.cosine_similarity(rendering.normal @ turn.T, guessed, dim=-1)
    return _saturating(1 - cosine, WRONG, counts, photo)


def depth_loss(
    rendering: Rendering, photo: Photo, guessed: Tensor, camera: Camera, disparity: bool, radius: float
) -> Tensor:
    """Compute how far rendered depth is from guessed depth: a scalar. The guess is first scaled and shifted to fit best.

    `guessed` (H, W) is depth, or disparity if `disparity` is true; 0 where not known. `camera` is the photo's camera in the size of the
    guess. The loss of a pixel saturates: it is r² / (r² + FAR²), where r is the difference in units of `radius`, the scene's radius.
    """
    guessed, depth = at_pixels(guessed, camera, photo.camera), rendering.depth
    counts = _counts(rendering, photo) * (guessed > 0)
    guessed = torch.where(counts > 0, guessed, 0)  # a distant background would overflow
    target, fits = fitted(guessed, depth.detach(), counts, disparity, radius)
    return _saturating(((depth - target) / radius).square(), FAR**2, counts * fits, photo)


def at_pixels(values: Tensor, camera: Camera, pixels: Camera) -> Tensor:
    """Resample a map (H, W, …) of `camera` to the pixels of another camera, `pixels`. Returns the nearest values.

    Both cameras have the same pose. `pixels` may have another size, or be a crop.
    """
    found = []
    for axis, (size, focal, centre) in enumerate((("height", "fy", "cy"), ("width", "fx", "cx"))):
        offset = torch.arange(getattr(pixels, size), device=values.device) + (0.5 - getattr(pixels, centre))
        place = offset * (getattr(camera, focal) / getattr(pixels, focal)) + getattr(camera, centre)
        found.append(place.long().clamp(0, values.shape[axis] - 1))
    return values[found[0]][:, found[1]]


def fitted(guessed: Tensor, depth: Tensor, counts: Tensor, disparity: bool, radius: float) -> tuple[Tensor, Tensor]:
    """Scale and shift guessed depth or disparity (H, W) to fit `depth` (H, W) best, by robust least squares.

    A pixel's weight is its value in `counts`, times a Cauchy weight: 1/2 where the fit is FAR scene radii from `depth`. Returns the fitted
    depth (H, W), and a scalar: 1 if the fitted scale is positive, else 0. `depth` must be detached.
    """
    wanted = 1 / depth.clamp_min(1e-6 * radius) if disparity else depth
    weight, found, slope = counts, depth, counts
    for _ in range(ROUNDS):
        total = weight.sum().clamp_min(1e-6)
        means = (weight * guessed).sum() / total, (weight * wanted).sum() / total
        apart = guessed - means[0], wanted - means[1]
        slope = (weight * apart[0] * apart[1]).sum() / (weight * apart[0].square()).sum().clamp_min(1e-12)
        found = means[1] + slope * apart[0]
        if disparity:
            found = 1 / found.clamp_min(1e-6 / radius)
        weight = counts / (1 + ((found - depth) / (FAR * radius)).square())
    return found, (slope > 0).to(depth)


def axes_of(pairs: Iterable[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor | None, float]:
    """Find the axes of guessed normals. Each of `pairs` has three sets of unit vectors (P, 3) for P pixels of one view:

    - the surface's normals, in the camera's axes (x right, y down, z forward)
    - the guessed normals, as they are in the file
    - the guessed normals turned to the camera's axes, for the case that the file has them in world space

    Returns the signs (3,) by which to multiply the file's x, y and z, or None if the normals are in world space. The answer with the larger
    mean cosine is chosen. Also returns how well the guesses then agree with the surface: the smaller of the correlations in x and in y.
    """
    sums = torch.zeros(2, 3, 3, dtype=torch.float64)
    for seen, *guesses in pairs:
        for row, guess in zip(sums, guesses, strict=True):
            products = torch.stack([seen * guess, seen.square(), guess.square()]).double()
            row += products.sum(dim=1).cpu()
    together, ours, theirs = sums.unbind(dim=1)
    across = together[:, :2] / (ours * theirs)[:, :2].sqrt().clamp_min(1e-12)
    if together[0].abs().sum() >= together[1].sum():
        return together[0].sign(), float(across[0].abs().min())
    return None, float(across[1].min())


def _with_axes(state: State, normals: Maps) -> Maps:
    """Turn maps of normals to their cameras' axes; return {} if their axes are unknown."""
    if not normals:
        return {}
    turn = split_similarity(state.capture.to_capture)[1]

    def to_camera(view: int) -> Tensor:
        """Return the rotation (3, 3) from the files' world to the view's camera."""
        return torch.from_numpy(state.views[view].camera.world_to_camera[:3, :3] @ turn.T).to(state.device).float()

    def pairs() -> Iterable[tuple[Tensor, Tensor, Tensor]]:
        for view in spread([*normals], PRIOR_VIEWS):
            photo = state.photo(view)
            rendering = state.render(photo.camera)
            guessed = at_pixels(*normals[view], photo.camera).float() / CODE
            chosen = _near_outline(photo) & (rendering.alpha > SOLID) & (guessed.square().sum(dim=-1) > 0.5)
            rotation = torch.from_numpy(photo.camera.world_to_camera[:3, :3].copy()).to(guessed)
            seen = torch.nn.functional.normalize(rendering.normal[chosen], dim=-1) @ rotation.T
            yield seen, guessed[chosen], guessed[chosen] @ to_camera(view).T

    signs, agreement = axes_of(pairs())
    count = f"normals from elsewhere for {len(normals)} of {len(state.views)} photos"
    if agreement < AGREES:
        why = f"they do not agree with the outlines, whatever their axes are (correlation {agreement:.2f})"
        state.announce("prior normals", f"without {count}: {why}")
        return {}
    if signs is None:
        axes = "in world space"
        for view, (codes, camera) in normals.items():
            normals[view] = (codes.float() @ to_camera(view).T).round().to(torch.int8), camera
    else:
        words = ("left", "right"), ("up", "down"), ("to the camera", "away")
        named = (pair[int(sign > 0)] for pair, sign in zip(words, signs, strict=True))
        axes = ", ".join(f"{axis} {word}" for axis, word in zip("xyz", named, strict=True))
        by = signs.to(state.device, torch.int8)
        normals = {view: (codes * by, camera) for view, (codes, camera) in normals.items()}
    state.announce("prior normals", f"with {count}: {axes} (correlation with the outlines {agreement:.2f})")
    return normals


def _near_outline(photo: Photo) -> Tensor:
    """Tell which pixels (H, W) lie just inside the outline of a photo's mask."""
    # The visual hull has the surface's normals there. Farther inside it may not: over a bowl, the hull has a lid.
    if photo.mask is None:
        return torch.zeros(photo.image.shape[:2], dtype=torch.bool, device=photo.image.device)
    shown = (photo.mask > 127).float()[None]
    reach = max(1, max(photo.mask.shape) // OUTLINE)
    deep = -torch.nn.functional.max_pool2d(-shown, 2 * reach + 1, stride=1, padding=reach)
    return (shown > deep)[0]


def _with_kind(state: State, depth: Maps) -> tuple[Maps, bool]:
    """Return the maps ({} if unrelated to the initial depth), and whether they hold disparities."""
    if not depth:
        return {}, False
    found = []
    for view in spread([*depth], PRIOR_VIEWS):
        photo = state.photo(view)
        rendering = state.render(photo.camera)
        guessed = at_pixels(*depth[view], photo.camera)
        chosen = (_counts(rendering, photo) > SOLID) & (guessed > 0)
        pair = torch.stack([guessed[chosen], rendering.depth[chosen]]).double()
        found.append(float(pair.corrcoef()[0, 1].nan_to_num()) if pair.shape[1] > 1 else 0.0)
    agreement, count = sum(found) / len(found), f"depth from elsewhere for {len(depth)} of {len(state.views)} photos"
    if abs(agreement) < AGREES:
        why = f"it neither rises nor falls with that of the outlines' shape (correlation {agreement:.2f})"
        state.announce("prior depth", f"without {count}: {why}")
        return {}, False
    kind = "a disparity" if agreement < 0 else "a depth"
    state.announce("prior depth", f"with {count}: {kind} (correlation with the outlines' shape {agreement:.2f})")
    return depth, agreement < 0


def _counts(rendering: Rendering, photo: Photo) -> Tensor:
    """Return pixels' weights (H, W): the mask's alpha (0..1), or 0 where not opaque."""
    opaque = (rendering.alpha.detach() > SOLID).float()
    return opaque if photo.mask is None else opaque * (photo.mask.float() / 255)


def _saturating(error: Tensor, half: float, counts: Tensor, photo: Photo) -> Tensor:
    """Compute Σ counts · error / (error + half) per pixel of the whole photo."""
    # Wrong priors have a limited effect: an error of `half` gives 1/2, a much larger one nearly 1.
    rows, columns = photo.whole or photo.image.shape[:2]
    return (counts * error / (error + half)).sum() / (rows * columns)
