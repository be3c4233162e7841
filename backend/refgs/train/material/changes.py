"""Measure how the object's radiance changes with the viewing direction, and whether it changes as a metal's does.

Nothing here needs normals that are right: an embossed metal has no sharp reflections, yet the radiance of each of its points changes from
photo to photo. A matte surface under a light that stands still looks the same from everywhere.
"""

import math
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from refgs.color import srgb_decode, srgb_encode
from refgs.model import harmonics
from refgs.model.environment import turn_between
from refgs.model.surfels import Surfels
from refgs.train import probe
from refgs.train.photo import Photo
from refgs.train.state import State

VIEWS = 24  # photos that are looked at, at the most
SWEEPS = 2  # steps in which surfels' radiance is fitted to the photos
OVERSHOOT = 1.5  # of the later steps: surfels share pixels, so that plain steps are too short
FACING = 0.4  # least cosine between a surfel's normal and the camera; nearer to grazing even matte surfaces change, by Fresnel
LEAST_PIXELS = 0.5  # of a surfel in a photo; a smaller part of it tells more of its neighbours
LEAST_VIEWS = 6  # of a surfel
LEAST_CLIPPED = 0.05  # of a surfel's pixels in a photo; then its highlights look whiter than they are
DARK = 0.03  # linear radiance below which a surfel does not count for a photo's exposure
NEIGHBOURS = 64  # surfels whose changes are pooled, as one alone has too few photos
FEW = 32  # of them, where the size of the change is asked and not its colour: pooling evens it out
SATURATED = 0.08  # distance of a chromaticity from grey, below which metals and dielectrics change alike: silver has 0.03, copper 0.14
CHANGES = 0.15  # change relative to the mean radiance, below which it may be texture that is slightly out of place
FAINT_CHANGES = 0.08  # enough where neighbours change clearly, and alike
FAINTEST_CHANGES = 0.05  # may be noise, unless nearly all of the surface has them; embossed gold has 0.07 to 0.2
GROWTH = 8  # steps from neighbours to neighbours
LOW = 0.15  # part of the photos in which a surfel is darker than where its drop is measured; fewer may be shadows or outlines
DROP = 0.08  # of the light's mean radiance; a dielectric mirrors 0.04 of the light, and so cannot fall by much more below its median
FALLS = 0.88  # part of its median to which a metal falls, which has no diffuse light; paint falls to 0.94 or less far
METAL = 0.6  # tint of the change (0: grey as a dielectric's reflection; 1: of the surface's own colour)


class Observations(NamedTuple):
    """Hold what some photos show of each of N surfels.

    - `mean` (N, 3): linear radiance, the same in all V photos, that explains them best.
    - `change` (N, V, 3): how far the radiance in a photo is from `mean`.
    - `pixels` (N, V): the surfel's blending weights in a photo, summed over its pixels; 0 where it is not usable.
    - `clipped` (N, V): the part of `pixels` where the photo is clipped, so that its colour is not known.
    - `normal` (N, V, 3): the surfel's normal towards the camera, in the frame in which the light stands still.
    - `towards` (N, V, 3): the direction from the surfel to the camera, in that frame.
    """

    mean: Tensor
    change: Tensor
    pixels: Tensor
    clipped: Tensor
    normal: Tensor
    towards: Tensor

    @property
    def usable(self) -> Tensor:
        """Tell which photos of which surfels count (N, V): none of a surfel that too few photos show."""
        shown = self.pixels > LEAST_PIXELS
        return shown & (shown.sum(dim=1, keepdim=True) >= LEAST_VIEWS)


class Shining(NamedTuple):
    """Tell which surfels (N,) change with the view in their own colour.

    - `clearly`: those that change by CHANGES of their mean radiance, or by FAINT_CHANGES beside such.
    - `faintly`: those that change by FAINTEST_CHANGES.
    - `tells`: those that are coloured and seen well enough to tell.
    """

    clearly: Tensor
    faintly: Tensor
    tells: Tensor


@torch.no_grad()
def observe(state: State) -> Observations:
    """Compare some training photos with a model in which each surfel looks the same from everywhere.

    The model's radiance is fitted to the photos, with an exposure for each photo. If the light turns with the camera, the diffuse light on
    a matte surface changes from photo to photo, too: then the model also has spherical harmonics of degree 2 of the normal in the camera's
    frame, as irradiance has (Ramamoorthi and Hanrahan 2001). What occludes a surfel, and what it shares pixels with, is part of the model.
    """
    surfels = Surfels(*(value.detach() for value in state.surfels()))
    photos = [state.photo(view) for view in probe.spread_views(state, VIEWS)]
    normals = surfels.normals()
    places = torch.stack([torch.from_numpy(photo.camera.position) for photo in photos]).to(normals)
    towards = torch.nn.functional.normalize(places - surfels.positions[:, None], dim=2)
    cosines = (towards * normals[:, None]).sum(dim=2)
    facing = cosines.sign()[..., None] * normals[:, None]
    light = None
    if state.settings.light.frame == "camera":
        turns = [torch.from_numpy(turn_between(photo.camera, state.views[0].camera)).to(normals) for photo in photos]
        facing, towards = (torch.einsum("vij,nvj->nvi", torch.stack(turns), each) for each in (facing, towards))
        light = harmonics.basis(facing.flatten(0, 1), 2).unflatten(0, facing.shape[:2])
    mean = torch.zeros_like(normals)
    factor = torch.ones_like(cosines)  # of the mean in a photo: its exposure and its diffuse light
    for sweep in range(SWEEPS):
        totals, pixels, _ = _residuals(surfels, photos, mean, factor, state.near)
        step = (totals.sum(dim=1) / pixels.sum(dim=1).clamp_min(1e-6)[:, None]) * (OVERSHOOT if sweep else 1.0)
        mean = (mean + step).clamp_min(0)
        if sweep:
            factor = _fitted(factor, totals, pixels, mean, light)
    totals, pixels, burnt = _residuals(surfels, photos, mean, factor, state.near)
    usable = pixels * (cosines.abs() > FACING)
    some = pixels.clamp_min(1e-6)
    return Observations(mean, totals / some[..., None], usable, burnt / some, facing, towards)


def linear(photo: Photo) -> Tensor:
    """Return a photo's linear radiance (H, W, 3) over black."""
    image = srgb_decode(photo.encoded)
    return image if photo.mask is None else image * (photo.mask.float() / 255)[..., None]


def _residuals(
    surfels: Surfels, photos: list[Photo], mean: Tensor, factor: Tensor, near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Sum what the photos show beyond the model over each surfel's pixels, with its blending weights.

    Returns the sums (N, V, 3), the sums of the weights (N, V), and those of clipped pixels (N, V).
    """
    sums = []
    for number, photo in enumerate(photos):
        # Decoded anew each time: as floats, all photos together would take five times their memory.
        target, lost = linear(photo), photo.clipped.any(dim=-1, keepdim=True).float()
        features = torch.cat([mean * factor[:, number, None], torch.ones_like(mean[:, :2])], dim=1)

        def residual(shown: Tensor, target: Tensor = target, lost: Tensor = lost) -> Tensor:
            return torch.cat([target - shown[..., :3], torch.ones_like(lost), lost], dim=-1)

        sums.append(probe.pixel_sums(surfels, photo, near, features, residual))
    totals, pixels, burnt = torch.stack(sums, dim=1).split([3, 1, 1], dim=2)
    return totals, pixels[..., 0], burnt[..., 0]


def _fitted(factor: Tensor, totals: Tensor, pixels: Tensor, mean: Tensor, light: Tensor | None) -> Tensor:
    """Fit the factor of each surfel in each photo (N, V) to the residuals.

    `light` (N, V, 9) are harmonics of the diffuse light. Without it, a factor depends on the photo alone. A photo's factor is a median,
    which highlights hardly move.
    """
    brightness = mean.mean(dim=1)
    known = (pixels > LEAST_PIXELS) & (brightness > DARK)[:, None]
    wrong = totals.mean(dim=2) / (pixels * factor * brightness[:, None]).clamp_min(1e-6)
    if light is not None:
        rows, values = light[known], wrong[known].clamp(-1, 1)
        square = rows.T @ rows + 1e-3 * len(rows) * torch.eye(rows.shape[1], device=rows.device)
        more = light @ torch.linalg.solve(square, rows.T @ values)
        factor, wrong = factor * (1 + more.clamp(-0.5, 0.5)), wrong - more
    of_photo = [wrong[which, v].median() if which.any() else wrong.new_zeros(()) for v, which in enumerate(known.T)]
    factor = factor * (1 + torch.stack(of_photo))
    return factor / factor.mean()


@torch.no_grad()
def change_seen(observations: Observations, wanted: Tensor) -> float:
    """Measure how much the surface changes with the viewing direction: a cubic mean over the surfels `wanted` (N,).

    A surfel's change is the standard deviation of its sRGB-encoded colour over the photos. Each surfel counts with its pixels. A cubic mean
    lets a small part that changes much, such as a chrome handle, count more than a plain mean would. 0 if no surfel is usable.
    """
    usable = observations.usable
    count = usable.sum(dim=1).clamp_min(2)
    mean = observations.mean[:, None]
    colour = srgb_encode((mean + observations.change).clamp(0, 1)) * usable[..., None]
    centre = colour.sum(dim=1, keepdim=True) / count[:, None, None]
    square = ((colour - centre).square().mean(dim=2) * usable).sum(dim=1) / (count - 1)
    weight = (observations.pixels * usable).sum(dim=1) * wanted
    return float(((square.pow(1.5) * weight).sum() / weight.sum().clamp_min(1e-6)) ** (1 / 3))


@torch.no_grad()
def shines_as_metal(observations: Observations, positions: Tensor) -> Shining:
    """Find the surfels that change with the view as a coloured metal does.

    A metal tints what it reflects: its radiance changes along its own colour. A dielectric's reflection has the light's colour, grey on the
    average, whatever the colour below. The direction of change is the first principal axis of the linear radiance over the photos. Radiance
    is averaged over neighbours first: texture that is slightly out of place then cancels, and highlights do not. Surfels near grey tell
    nothing.
    """
    near = neighbours(positions, NEIGHBOURS)
    mean, change, known = averaged(observations, near)
    count = known.sum(dim=1).clamp_min(1)[:, None, None]
    change = (change - change.sum(dim=1, keepdim=True) / count) * known[..., None]
    relative = change / mean.mean(dim=1)[:, None, None].clamp_min(1e-2)
    covariance = relative.transpose(1, 2) @ relative / count
    axis = torch.linalg.eigh(covariance).eigenvectors[:, :, 2]
    axis = axis * torch.sign(axis.sum(dim=1, keepdim=True))
    axis = axis / axis.sum(dim=1, keepdim=True).clamp_min(0.2)
    own = from_grey(mean)
    saturation = own.norm(dim=1)
    tint = ((axis - 1 / 3) * own).sum(dim=1) / saturation.square().clamp_min(1e-6)
    size = covariance.diagonal(dim1=1, dim2=2).mean(dim=1).sqrt()
    tells = (known.sum(dim=1) >= LEAST_VIEWS) & (saturation > SATURATED)
    tinted = tells & (tint > METAL)
    metal, beside = tinted & (size > CHANGES), tinted & (size > FAINT_CHANGES)
    for _ in range(GROWTH):
        metal = metal | beside & (pooled(metal.float()[:, None], near)[:, 0] > near.shape[1] / 4)
    return Shining(metal, tinted & (size > FAINTEST_CHANGES), tells)


@torch.no_grad()
def falls_as_metal(observations: Observations, positions: Tensor, light: float) -> Tensor:
    """Find the surfels (N,) that fall so far below their median in some photos that only a metal does, grey or not.

    A dielectric's diffuse radiance is the same in all photos, and it mirrors only a twenty-fifth of the light: its highlights may rise far,
    but without them it is hardly darker than in the median. A metal is as dark as what it mirrors. `light` is the light's mean radiance.
    Radiance is averaged over a few neighbours, so that texture that is slightly out of place hardly counts.
    """
    near = neighbours(positions, FEW)
    mean, change, known = averaged(observations, near)
    radiance = (mean[:, None] + change).mean(dim=2).clamp_min(0).masked_fill(~known, math.nan)
    median, low = radiance.nanquantile(0.5, dim=1), radiance.nanquantile(LOW, dim=1)
    usable = known.sum(dim=1) >= LEAST_VIEWS
    return usable & (median - low > DROP * light) & (low < FALLS * median)


def from_grey(colour: Tensor) -> Tensor:
    """Return how far the chromaticities of linear colours (N, 3) are from grey's (N, 3)."""
    return colour / colour.sum(dim=1, keepdim=True).clamp_min(1e-6) - 1 / 3


def averaged(observations: Observations, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Average observations over each surfel's neighbours, as listed in `near` (N, K).

    Returns the mean radiance (N, 3), the changes (N, V, 3), and which photos show them unclipped (N, V).
    """
    weight = observations.pixels * (observations.clipped < LEAST_CLIPPED) * (observations.pixels > LEAST_PIXELS)
    pixels = pooled(weight, near)
    known = pixels > LEAST_PIXELS
    change = pooled((observations.change * weight[..., None]).flatten(1), near).view_as(observations.change)
    change = torch.where(known[..., None], change / pixels.clamp_min(1e-6)[..., None], 0)
    seen = observations.pixels.sum(dim=1, keepdim=True)
    mean = (pooled(observations.mean * seen, near) / pooled(seen, near).clamp_min(1e-6)).clamp_min(1e-4)
    return mean, change, known


def neighbours(positions: Tensor, most: int, of: Tensor | None = None) -> Tensor:
    """Return the indices (M, K) of each surfel's nearest surfels, itself among them: K is `most`, or N if there are fewer.

    The mask `of` (N,) chooses whose are returned; all surfels' if it is None.
    """
    points = positions.numpy(force=True)
    chosen = points if of is None else positions[of].numpy(force=True)
    ranks = [*range(1, min(most, len(points)) + 1)]
    near = cKDTree(points).query(chosen, k=ranks, workers=torch.get_num_threads())[1]
    return torch.from_numpy(near).to(positions.device)


def pooled(values: Tensor, near: Tensor) -> Tensor:
    """Sum the rows of `values` (N, …) over neighbours, as listed in `near` (M, K). Returns (M, …)."""
    total = values.new_zeros(len(near), *values.shape[1:])
    for column in near.T:
        total += values[column]
    return total
