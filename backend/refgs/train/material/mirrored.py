"""Compare what photos show of each surfel with what it would show as a metal, and as paint, under the light learned so far.

A metal shows what it mirrors, times its reflectance. Paint shows its diffuse radiance, the same in all photos, and about 4 % of what it
mirrors. Both are fitted to some photos by least squares. A surfel mirrors the light or, where its mirror ray meets the object, the mean
radiance that photos show there. So the material of the mirrored surface need not be known.

In a dark room, the light is learned too bright where it is dark. Then black paint explains a metal as well. So surfels are also judged
without the light, by the photos in which their mirror ray meets the object (see `_by_object`).
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import smooth_normals
from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.brdf import look_up
from refgs.render.relight import blend, mirror
from refgs.train import probe
from refgs.train.material.observe import GRAZING, NEIGHBOURS, OBSERVED_VIEWS, Seen, neighbours, observe_mirrored, pooled
from refgs.train.state import State

ROUGHNESSES = 0.05, 0.2, 0.45  # roughnesses that are tried
TOLERANCE = 0.15  # fraction of the radiance: smaller errors of either kind tell nothing
ENOUGH_PIXELS = 30.0  # least sum of the neighbours' pixels in all photos
BRIGHTEST = 20.0  # largest radiance of a mirrored lamp: photos clip it
# A surfel without diffuse radiance falls below DIM times its median in a tenth of the photos. In dark rooms, the middle 80 % of silver
# and chrome fall to 0.15 to 0.65; those of clay, wood, stone and red plastic to 0.56 to 0.93.
DIM, DIMMEST = 0.6, 0.1
# Least reflectance of a metal, by the light or by what it mirrors of the object. By the light, painted plastic reaches 0.3, and most metals
# have more than 0.4. By the object, silver has 0.83, chrome 0.57, a black glaze 0.14.
REFLECTANCE = 0.35
LEAST_SHOWN = 0.02  # least mean radiance of what a surfel mirrors of the object: in less, errors tell more
TOLD = 0.2  # ratio of errors of a surfel that shows the object as a metal does


class Fit(NamedTuple):
    """Hold how well metal and paint explain what photos show of each of N surfels and its neighbours.

    - `ratio` (N,): the squared error as a metal, divided by that as paint; TOLD where `_by_object` finds a metal
    - `slope` (N,): how much the shown radiance grows per unit of mirrored radiance, by a straight line fitted over the photos; 1 there
    - `reflectance` (N, 3), `roughness` (N,): values of the metal that fits best
    - `seen` (N,): whether photos show the surfel and its neighbours in enough pixels
    - `by_object` (N,): whether `_by_object` finds a metal, so that the other values do not depend on the light
    """

    ratio: Tensor
    slope: Tensor
    reflectance: Tensor
    roughness: Tensor
    seen: Tensor
    by_object: Tensor


@torch.no_grad()
def fit_both(state: State) -> tuple[Surfels, Seen, Fit]:
    """Observe the surfels in some training photos, and fit both materials to them. Returns surfels, observations and fit, on the CPU.

    The state must have a light. Without a mesh (`state.occluder`), surfels are taken to mirror the light alone, and not the object.
    """
    photos = probe.spread_views(state, OBSERVED_VIEWS)
    inputs = state.inputs()
    inputs = inputs._replace(surfels=Surfels(*(value.detach() for value in inputs.surfels)))
    seen = observe_mirrored(state, inputs, photos)
    surfels = Surfels(*(value.cpu() for value in inputs.surfels))
    turns = [torch.from_numpy(inputs.light.turn(state.photo(view).camera)).float() for view in photos]
    light = Environment(inputs.light.radiance.cpu())
    return surfels, seen, _fit(seen, _mirrored(state, surfels, seen, light, turns), surfels.positions)


class Rays(NamedTuple):
    """Hold the N surfels' mirror rays of one photo: unit directions (N, 3), and the faces (N,) and places (N, 3) that they meet.

    `face` is −1 where a ray does not meet the object. `inside` are barycentric coordinates on the face.
    """

    direction: Tensor
    face: np.ndarray
    inside: np.ndarray


def mirror_rays(state: State, surfels: Surfels, seen: Seen) -> Iterator[Rays]:
    """Trace the surfels' mirror rays of each photo in `seen`. Without a mesh (`state.occluder`), they do not meet the object."""
    points = surfels.positions.double().numpy()
    for normal, towards in zip(seen.normal.unbind(dim=1), seen.towards.unbind(dim=1), strict=True):
        direction = mirror(-towards, normal)
        face, inside = np.full(len(points), -1), np.zeros((len(points), 3), np.float32)
        if state.occluder is not None:
            face, inside = state.occluder.meet(points, normal.double().numpy(), direction.double().numpy())
        yield Rays(direction, face, inside)


def _mirrored(
    state: State, surfels: Surfels, seen: Seen, light: Environment, turns: list[Tensor]
) -> Iterator[tuple[list[Tensor], Tensor]]:
    """Yield, for each photo, the linear radiance that the surfels mirror towards its camera: a tensor (N, 3) for each of ROUGHNESSES.

    Also yields the mask (N,) of surfels whose mirror ray meets the object.

    `turns` has a rotation matrix (3, 3) for each photo. It turns directions in the run's frame into those in which `light` is sampled.
    """
    levels, occluder = cubemap.in_texel_order(light.levels, light.sides), state.occluder
    there = torch.zeros(0, 3) if occluder is None else _at_vertices(surfels, seen, occluder.mesh)
    for turn, rays in zip(turns, mirror_rays(state, surfels, seen), strict=True):
        levels_of = (torch.full((len(rays.face),), float(prefilter.level_of(roughness))) for roughness in ROUGHNESSES)
        shown = [cubemap.sample(levels, light.sides, rays.direction @ turn.T, level) for level in levels_of]
        met = rays.face >= 0
        of_object = torch.from_numpy(met)
        if occluder is not None:
            corners = there[torch.from_numpy(occluder.mesh.faces[rays.face[met]]).long()]
            radiance = (corners * torch.from_numpy(rays.inside[met])[..., None]).sum(dim=1)
            for each in shown:
                each[of_object] = radiance
        yield [each.clamp_max(BRIGHTEST) for each in shown], of_object


def _at_vertices(surfels: Surfels, seen: Seen, mesh: Mesh) -> Tensor:
    """Return the mean radiance (M, 3) that photos show at the vertices of a mesh."""
    normals = smooth_normals(mesh.vertices, mesh.faces)
    return torch.from_numpy(blend(surfels, seen.outward.double().numpy(), mesh.vertices, normals) @ seen.mean.numpy())


def _fit(seen: Seen, mirrored: Iterable[tuple[list[Tensor], Tensor]], positions: Tensor) -> Fit:
    """Fit metal and paint to all photos, for each of ROUGHNESSES. Keep each surfel's best metal and best paint.

    Let R be what a surfel mirrors: `mirrored`, from `_mirrored`. A metal of reflectance s shows (s FG0 + FG1) R. Paint of diffuse radiance
    c shows c + F R. FG0, FG1 and F are the channels 0, 1 and 3 of `brdf.reflectance_table`. Both fits need only sums over the photos.
    """
    near, count = neighbours(positions, NEIGHBOURS), len(positions)
    names, shape = ("rest", "both", "power", "paint", "first"), (len(ROUGHNESSES), count, 3)
    sums = {name: torch.zeros(shape, dtype=torch.double) for name in names}
    # Weighted sums: mirrored, shown, their product, the square of the mirrored.
    changes = torch.zeros(count, 4, dtype=torch.double)
    of_object = torch.zeros(count, 8, dtype=torch.double)  # sums of `_by_object`
    for view, (lights, met) in enumerate(mirrored):
        shown, weight = seen.radiance[:, view], seen.weight[:, view, None].double()
        cosine = (seen.normal[:, view] * seen.towards[:, view]).sum(dim=1).clamp(GRAZING, 1)
        for index, (roughness, light) in enumerate(zip(ROUGHNESSES, lights, strict=True)):
            first, second, _, coat = look_up(cosine, torch.full_like(cosine, roughness)).unsqueeze(2).unbind(dim=1)
            rest, reflected, dull = shown - second * light, first * light, shown - coat * light
            sums["rest"][index] += weight * rest.square()
            sums["both"][index] += weight * rest * reflected
            sums["power"][index] += weight * reflected.square()
            sums["paint"][index] += weight * dull.square()
            sums["first"][index] += weight * dull
            if index == 0:
                terms = [rest * reflected, reflected.square(), torch.ones_like(weight), light.mean(dim=1, keepdim=True)]
                of_object += weight * met[:, None] * torch.cat(terms, dim=1)
        x, y = lights[1].mean(dim=1), shown.mean(dim=1)
        changes += weight * torch.stack([x, y, x * y, x * x], dim=1)
    total = seen.weight.sum(dim=1, keepdim=True).double()
    some = total.clamp_min(1e-6)
    reflectance = (sums["both"] / sums["power"].clamp_min(1e-12)).clamp(0, 1)
    metal = (sums["rest"] - 2 * reflectance * sums["both"] + reflectance.square() * sums["power"]).sum(dim=2)
    diffuse = (sums["first"] / some).clamp_min(0)
    paint = (sums["paint"] - 2 * diffuse * sums["first"] + diffuse.square() * total).sum(dim=2)
    weights = seen.weight[..., None].double()
    middle = (seen.radiance * weights).sum(dim=1) / some
    steady = ((seen.radiance - middle[:, None]).square() * weights).sum(dim=(1, 2))
    least = (TOLERANCE**2 * seen.radiance.square() * weights).sum(dim=(1, 2))
    metal, paint = (pooled(errors.clamp_min(0).T, near) for errors in (metal, torch.cat([paint, steady[None]])))
    least = pooled(least[:, None], near)[:, 0]
    ratio = (metal.amin(dim=1) + least) / (paint.amin(dim=1) + least).clamp_min(1e-12)
    x, y, product, square = (changes / some).unbind(dim=1)
    moved = pooled(torch.stack([product - x * y, square - x * x], dim=1) * total, near)
    slope = moved[:, 0] / moved[:, 1].clamp_min(1e-9)
    best = metal.argmin(dim=1)
    chosen = reflectance[best, torch.arange(count)] * total
    weighed = pooled(torch.cat([chosen, total], dim=1), near)
    mean = weighed[:, :3] / weighed[:, 3:].clamp_min(1e-6)
    told, by_object = _by_object(seen, of_object, near)
    return Fit(
        torch.where(told, TOLD, ratio.float()),
        torch.where(told, 1.0, slope.float()),
        torch.where(told[:, None], by_object, mean.float()),
        torch.where(told, ROUGHNESSES[0], torch.tensor(ROUGHNESSES)[best]),
        (weighed[:, 3] > ENOUGH_PIXELS) | told,
        told,
    )


def _by_object(seen: Seen, sums: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Find metals without the light, by the photos in which they mirror the object: a mask (N,), and their reflectances (N, 3).

    A metal shows what it mirrors of the object, times its reflectance, and is darker in other photos than any paint but black. Black paint
    shows a twentieth of what it mirrors. `sums` (N, 8) are weighted sums over those photos: what a metal would show times what is shown
    (3), the square of what it would show (3), the weights, and the mirrored radiance. `near` are the neighbours to average over.
    """
    sums = pooled(sums, near)
    reflectance = (sums[:, :3] / sums[:, 3:6].clamp_min(1e-12)).clamp(0, 1).float()
    shown = seen.radiance.mean(dim=2).masked_fill(seen.weight <= 0, math.nan)
    levels = torch.stack([shown.nanquantile(of, dim=1).nan_to_num() for of in (DIMMEST, 0.5)], dim=1)
    dimmest, median = pooled(levels * seen.pixels[:, None], near).unbind(dim=1)
    enough = (sums[:, 6] > ENOUGH_PIXELS) & (sums[:, 7] > LEAST_SHOWN * sums[:, 6])
    return enough & (dimmest < DIM * median) & (reflectance.amax(dim=1) > REFLECTANCE), reflectance
