"""Compare what photos show of each surfel with what it would show as a metal, and as paint, under the light learned so far.

A metal shows what it mirrors, times its reflectance. Paint shows its diffuse radiance, the same in all photos, and about 4 % of what it
mirrors. Both are fitted to some photos by least squares. A surfel mirrors the light or, where its mirror ray meets the object, the mean
radiance that photos show there. So the material of the mirrored surface need not be known.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

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


class Fit(NamedTuple):
    """Hold how well metal and paint explain what photos show of each of N surfels and its neighbours.

    - `ratio` (N,): the squared error as a metal, divided by that as paint
    - `slope` (N,): how much the shown radiance grows per unit of mirrored radiance, by a straight line fitted over the photos
    - `reflectance` (N, 3), `roughness` (N,): values of the metal that fits best
    - `seen` (N,): whether photos show the surfel and its neighbours in enough pixels
    """

    ratio: Tensor
    slope: Tensor
    reflectance: Tensor
    roughness: Tensor
    seen: Tensor


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


def _mirrored(
    state: State, surfels: Surfels, seen: Seen, light: Environment, turns: list[Tensor]
) -> Iterator[list[Tensor]]:
    """Yield, for each photo, the linear radiance that the surfels mirror towards its camera: a tensor (N, 3) for each of ROUGHNESSES.

    `turns` has a rotation matrix (3, 3) for each photo. It turns directions in the run's frame into those in which `light` is sampled.
    """
    levels, occluder = cubemap.in_texel_order(light.levels, light.sides), state.occluder
    there = torch.zeros(0, 3) if occluder is None else _at_vertices(surfels, seen, occluder.mesh)
    points = surfels.positions.double().numpy()
    for view, turn in enumerate(turns):
        normal = seen.normal[:, view]
        direction = mirror(-seen.towards[:, view], normal)
        levels_of = (torch.full((len(normal),), float(prefilter.level_of(roughness))) for roughness in ROUGHNESSES)
        shown = [cubemap.sample(levels, light.sides, direction @ turn.T, level) for level in levels_of]
        if occluder is not None:
            face, inside = occluder.meet(points, normal.double().numpy(), direction.double().numpy())
            met = face >= 0
            corners = there[torch.from_numpy(occluder.mesh.faces[face[met]]).long()]
            radiance = (corners * torch.from_numpy(inside[met])[..., None]).sum(dim=1)
            for each in shown:
                each[torch.from_numpy(met)] = radiance
        yield [each.clamp_max(BRIGHTEST) for each in shown]


def _at_vertices(surfels: Surfels, seen: Seen, mesh: Mesh) -> Tensor:
    """Return the mean radiance (M, 3) that photos show at the vertices of a mesh."""
    normals = smooth_normals(mesh.vertices, mesh.faces)
    return torch.from_numpy(blend(surfels, seen.outward.double().numpy(), mesh.vertices, normals) @ seen.mean.numpy())


def _fit(seen: Seen, mirrored: Iterable[list[Tensor]], positions: Tensor) -> Fit:
    """Fit metal and paint to all photos, for each of ROUGHNESSES. Keep each surfel's best metal and best paint.

    Let R be what a surfel mirrors: `mirrored`, from `_mirrored`. A metal of reflectance s shows (s FG0 + FG1) R. Paint of diffuse radiance
    c shows c + F R. FG0, FG1 and F are the channels 0, 1 and 3 of `brdf.reflectance_table`. Both fits need only sums over the photos.
    """
    near, count = neighbours(positions, NEIGHBOURS), len(positions)
    names, shape = ("rest", "both", "power", "paint", "first"), (len(ROUGHNESSES), count, 3)
    sums = {name: torch.zeros(shape, dtype=torch.double) for name in names}
    # Weighted sums: mirrored, shown, their product, the square of the mirrored.
    changes = torch.zeros(count, 4, dtype=torch.double)
    for view, lights in enumerate(mirrored):
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
    roughness = torch.tensor(ROUGHNESSES)[best]
    return Fit(ratio.float(), slope.float(), mean.float(), roughness, weighed[:, 3] > ENOUGH_PIXELS)
