"""Observe each surfel in the photos: how its radiance changes from photo to photo, and which normals are blended at its pixels."""

from typing import NamedTuple

import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from torch import Tensor

from refgs.model import harmonics
from refgs.model.environment import turn_between
from refgs.model.surfels import Surfels
from refgs.render.sums import pixel_sums
from refgs.train import probe
from refgs.train.learn.exposures import exposure
from refgs.train.photo import Photo
from refgs.train.state import RenderInputs, State

OBSERVED_VIEWS = 24  # photos that are looked at, at the most
SWEEPS = 2  # steps in which surfels' radiance is fitted to the photos
OVERSHOOT = 1.5  # factor on the later steps: surfels share pixels, so that plain steps are too short
FACING = 0.4  # least cosine between normal and camera; at grazing angles, Fresnel changes even matte surfaces
LEAST_PIXELS = 0.5  # pixels that a surfel must have in a photo; fewer tell more about its neighbours
LEAST_VIEWS = 6  # photos that must show a surfel
LEAST_CLIPPED = 0.05  # part of a surfel's pixels; where more are clipped, highlights look too white
DARK = 0.03  # linear radiance; darker surfels do not count for a photo's exposure
NEIGHBOURS = 64  # surfels whose changes are averaged, because too few photos show a single one
COLOURED = 0.08  # distance from grey; below it, metals and dielectrics change alike; silver has 0.03, copper 0.14
GRAZING = 0.15  # least cosine between normal and camera; at more grazing angles, normals are not good enough


class Kinds(NamedTuple):
    """Hold one number for metal surfaces and one for painted surfaces, such as two thresholds."""

    metal: float
    paint: float


class Observations(NamedTuple):
    """Hold what some photos show of each of N surfels.

    - `mean` (N, 3): linear radiance, the same in all V photos, that explains them best.
    - `change` (N, V, 3): how far the radiance in a photo is from the model's: `mean` times the photo's exposure (see `observe_changes`).
    - `pixels` (N, V): the surfel's blending weights in a photo, summed over its pixels; 0 if seen at a grazing angle.
    - `clipped` (N, V): the fraction of `pixels` where the photo is clipped, so that its colour is not known.
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
        """Tell which photos show which surfels well enough (N, V)."""
        shown = self.pixels > LEAST_PIXELS
        return shown & (shown.sum(dim=1, keepdim=True) >= LEAST_VIEWS)


class Seen(NamedTuple):
    """Hold what V photos show of each of N surfels, on the CPU.

    - `radiance` (N, V, 3): linear, without the photo's exposure
    - `clipped` (N, V, 3): bool, where the photo is clipped, so that the surfel has this radiance at least
    - `weight` (N, V): the surfel's blending weights, summed over its pixels; 0 where it is hardly seen, or at a grazing angle
    - `pixels` (N,): the surfel's blending weights, summed over its pixels in all photos, also where `weight` is 0
    - `mean` (N, 3): the mean radiance over the pixels that are counted in `pixels`
    - `normal` (N, V, 3): the unit normal that is blended at its pixels
    - `towards` (N, V, 3): the unit direction to the camera
    """

    radiance: Tensor
    clipped: Tensor
    weight: Tensor
    pixels: Tensor
    mean: Tensor
    normal: Tensor
    towards: Tensor

    def in_photo(self, view: int) -> Tensor:
        """Return the indices (M,) of the surfels that a photo shows: about a quarter of all."""
        return self.weight[:, view].nonzero()[:, 0]

    @property
    def exact(self) -> Tensor:
        """Return `weight` (N, V), but 0 where any channel is clipped."""
        return self.weight * ~self.clipped.any(dim=2)

    @property
    def outward(self) -> Tensor:
        """Return a unit normal (N, 3) of each surfel, towards the cameras that see it."""
        return torch.nn.functional.normalize((self.normal * self.weight[..., None]).sum(dim=1), dim=1)


@torch.no_grad()
def observe_changes(state: State) -> Observations:
    """Compare some training photos with a model in which each surfel looks the same from everywhere.

    The surfels' radiance is fitted to the photos, with an exposure for each photo. The model is rendered: surfels occlude each other, and
    several of them share a pixel.

    If the light turns with the camera, matte surfaces change from photo to photo, too. Then a factor for the irradiance is also fitted:
    spherical harmonics of degree 2 of the normal in the camera's frame (Ramamoorthi and Hanrahan 2001).
    """
    surfels = Surfels(*(value.detach() for value in state.surfels()))
    photos = [state.photo(view) for view in probe.spread_views(state, OBSERVED_VIEWS)]
    normals, towards = surfels.normals(), _towards(surfels, photos)
    cosines = (towards * normals[:, None]).sum(dim=2)
    facing = cosines.sign()[..., None] * normals[:, None]
    light = None
    if state.settings.light.frame == "camera":
        turns = [torch.from_numpy(turn_between(photo.camera, state.views[0].camera)).to(normals) for photo in photos]
        facing, towards = (torch.einsum("vij,nvj->nvi", torch.stack(turns), each) for each in (facing, towards))
        light = harmonics.basis(facing.flatten(0, 1), 2).unflatten(0, facing.shape[:2])
    mean = torch.zeros_like(normals)
    factor = torch.ones_like(cosines)  # factor on the mean in each photo: its exposure and its diffuse light
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


@torch.no_grad()
def observe_mirrored(state: State, inputs: RenderInputs, views: list[int]) -> Seen:
    """Observe the surfels in the training photos `views`, with exposures divided out."""
    inputs = inputs._replace(occluder=None)  # for normals, nothing needs to be traced
    sums = [_sums(state, inputs, view) for view in views]
    radiance, pixels, clipped, normal = torch.stack(sums, dim=1).cpu().split([3, 1, 3, 3], dim=2)
    towards = _towards(inputs.surfels, [state.photo(view) for view in views]).cpu()
    pixels = pixels[..., 0]
    mean = radiance.sum(dim=1) / pixels.sum(dim=1, keepdim=True).clamp_min(1e-6)
    some, normal = pixels.clamp_min(1e-6), torch.nn.functional.normalize(normal, dim=2)
    known = (pixels > LEAST_PIXELS) & ((normal * towards).sum(dim=2) > GRAZING)
    clipped = clipped >= LEAST_CLIPPED * some[..., None]
    return Seen(radiance / some[..., None], clipped, pixels * known, pixels.sum(dim=1), mean, normal, towards)


def _sums(state: State, inputs: RenderInputs, view: int) -> Tensor:
    """Sum each surfel's pixels (N, 10): linear radiance, weights, weights of clipped channels, and blended normals."""
    photo, factor = state.photo(view), exposure(state, view)
    radiance = photo.linear if factor is None else photo.linear / factor
    one = torch.ones_like(radiance[..., :1])
    shown = torch.cat([radiance, one, photo.clipped.float(), probe.picture(state, view, inputs).normal], dim=-1)
    features = torch.ones_like(inputs.surfels.positions[:, :1]).expand(-1, 10)
    return pixel_sums(inputs.surfels, photo.camera, state.near, features, lambda _: shown)


def _towards(surfels: Surfels, photos: list[Photo]) -> Tensor:
    """Return the unit directions (N, V, 3) from surfels to the photos' cameras."""
    places = torch.stack([torch.from_numpy(photo.camera.position) for photo in photos]).to(surfels.positions)
    return torch.nn.functional.normalize(places - surfels.positions[:, None], dim=2)


def _clipped(photo: Photo) -> Tensor:
    """Return 1 where any channel of a photo is clipped, else 0: (H, W, 1)."""
    return photo.clipped.any(dim=-1, keepdim=True).float()


def _residuals(
    surfels: Surfels, photos: list[Photo], mean: Tensor, factor: Tensor, near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Sum the photos' differences from the model over each surfel's pixels, weighted by its blending weights.

    The model shows a surfel in a photo as `factor` (N, V) times `mean` (N, 3). Returns the sums (N, V, 3), the sums of the weights (N, V),
    and the sums of the weights of clipped pixels (N, V).
    """
    sums = []
    for number, photo in enumerate(photos):
        # Decode each photo anew: as floats, all together would take five times their memory.
        target, lost = photo.linear, _clipped(photo)
        features = torch.cat([mean * factor[:, number, None], torch.ones_like(mean[:, :2])], dim=1)

        def residual(shown: Tensor, target: Tensor = target, lost: Tensor = lost) -> Tensor:
            return torch.cat([target - shown[..., :3], torch.ones_like(lost), lost], dim=-1)

        sums.append(pixel_sums(surfels, photo.camera, near, features, residual))
    totals, pixels, burnt = torch.stack(sums, dim=1).split([3, 1, 1], dim=2)
    return totals, pixels[..., 0], burnt[..., 0]


def _fitted(factor: Tensor, totals: Tensor, pixels: Tensor, mean: Tensor, light: Tensor | None) -> Tensor:
    """Correct each surfel's `factor` (N, V) in each photo by the residuals. In the model, a photo shows `factor` times `mean` (N, 3).

    `totals` and `pixels` are the residuals and weights from `_residuals`. A photo's exposure is part of all factors of this photo. This
    part is corrected by a median over surfels, which highlights hardly move. With `light` (N, V, 9), harmonics of the normals, factors are
    also corrected by the diffuse light. Finally, all factors are scaled to a mean of 1.
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


def from_grey(colour: Tensor) -> Tensor:
    """Return the chromaticities of linear colours (N, 3), minus that of grey."""
    return colour / colour.sum(dim=1, keepdim=True).clamp_min(1e-6) - 1 / 3


def averaged(observations: Observations, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Average observations over each surfel's neighbours, whose indices are `near` (N, K).

    Returns the averages of `mean` (N, 3) and of `change` (N, V, 3), and a mask (N, V) of where the change is known. Elsewhere it is 0.
    """
    weight = observations.pixels * (observations.clipped < LEAST_CLIPPED) * (observations.pixels > LEAST_PIXELS)
    pixels = pooled(weight, near)
    known = pixels > LEAST_PIXELS
    change = pooled(observations.change * weight[..., None], near)
    change = torch.where(known[..., None], change / pixels.clamp_min(1e-6)[..., None], 0)
    seen = observations.pixels.sum(dim=1, keepdim=True)
    mean = mean_over(near, observations.mean, seen).clamp_min(1e-4)
    return mean, change, known


def neighbours(positions: Tensor, most: int, of: Tensor | None = None) -> Tensor:
    """Return the indices (M, K) of the K surfels nearest to each surfel, itself included. K is `most`, or N if there are fewer.

    The mask `of` (N,) selects the surfels whose neighbours are returned. None selects all.
    """
    points = positions.numpy(force=True)
    chosen = points if of is None else positions[of].numpy(force=True)
    ranks = [*range(1, min(most, len(points)) + 1)]
    near = cKDTree(points).query(chosen, k=ranks, workers=torch.get_num_threads())[1]
    return torch.from_numpy(near).to(positions.device)


def pooled(values: Tensor, near: Tensor) -> Tensor:
    """Sum the rows of `values` (N, …) over neighbours `near` (M, K), giving (M, …)."""
    rows = values.reshape(len(values), -1)
    return torch.nn.functional.embedding_bag(near, rows, mode="sum").view(len(near), *values.shape[1:])


def mean_over(near: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    """Average the rows of `values` (N, C), weighted by `weight` (N, 1), over neighbours `near` (M, K), giving (M, C)."""
    return pooled(weight * values, near) / pooled(weight, near).clamp_min(1e-6)
