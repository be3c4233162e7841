"""Compare what photos show of each surfel with what it would show as a metal, and as paint, under the light learned so far.

A metal shows what it mirrors, times its reflectance. Paint shows its diffuse radiance, the same in all photos, and a twenty-fifth of what
it mirrors. Both are fitted to some photos by least squares. What a surfel mirrors is the light or, where its mirror ray meets the object,
the mean radiance that photos show there: so no material has to be known.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.geometry.mesh import smooth_normals
from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.brdf import look_up
from refgs.render.relight import blend, mirror
from refgs.train import probe
from refgs.train.state import RenderInputs, State
from refgs.train.view_dependence import LEAST_CLIPPED, LEAST_PIXELS, NEIGHBOURS, VIEWS, linear, neighbours, pooled

ROUGHNESSES = 0.05, 0.2, 0.45  # that are tried
GRAZING = 0.15  # least cosine between normal and camera: nearer to grazing, normals are not good enough
TOLERANCE = 0.15  # of the radiance: smaller errors of either kind tell nothing
SEEN = 30.0  # pixels of the neighbours in all photos, at least
BRIGHTEST = 20.0  # radiance of a mirrored lamp, at the most: photos clip it


class Seen(NamedTuple):
    """Hold what V photos show of each of N surfels, on the CPU.

    - `radiance` (N, V, 3): linear, without the photo's exposure
    - `weight` (N, V): the surfel's blending weights, summed over its pixels; 0 where the surfel is clipped, hardly seen or grazing
    - `pixels` (N,): the blending weights in all photos, wherever it is seen
    - `mean` (N, 3): the mean radiance, of all pixels
    - `normal` (N, V, 3): the unit normal that is blended at its pixels
    - `towards` (N, V, 3): the unit direction to the camera
    """

    radiance: Tensor
    weight: Tensor
    pixels: Tensor
    mean: Tensor
    normal: Tensor
    towards: Tensor

    @property
    def outward(self) -> Tensor:
        """Return one unit normal (N, 3) of each surfel, towards the cameras that see it."""
        return torch.nn.functional.normalize((self.normal * self.weight[..., None]).sum(dim=1), dim=1)


class Fit(NamedTuple):
    """Hold how well each of N surfels is explained, together with its neighbours.

    - `ratio` (N,): the squared error as a metal, divided by that as paint
    - `slope` (N,): how much the radiance changes with what is mirrored, from photo to photo
    - `reflectance` (N, 3), `roughness` (N,): of the metal that fits best
    - `seen` (N,): whether photos show enough of it
    """

    ratio: Tensor
    slope: Tensor
    reflectance: Tensor
    roughness: Tensor
    seen: Tensor


@torch.no_grad()
def observe(state: State) -> tuple[Surfels, Seen, Fit]:
    """Look at the surfels in some training photos, and fit both materials to them. Also returns the surfels, on the CPU.

    The state must have a light. What surfels mirror of the object is known only if the state has a mesh (`occluder`).
    """
    photos = probe.spread_views(state, VIEWS)
    inputs = state.inputs()
    inputs = inputs._replace(surfels=Surfels(*(value.detach() for value in inputs.surfels)))
    seen = _look(state, inputs, photos)
    surfels = Surfels(*(value.cpu() for value in inputs.surfels))
    turns = [torch.from_numpy(inputs.environment.turn(state.photo(view).camera)).float() for view in photos]
    light = Environment(inputs.environment.radiance.cpu())
    return surfels, seen, _fit(seen, _mirrored(state, surfels, seen, light, turns), surfels.positions)


def _look(state: State, inputs: RenderInputs, views: list[int]) -> Seen:
    positions, towards, sums = inputs.surfels.positions, [], []
    for view in views:
        camera = torch.from_numpy(state.photo(view).camera.position).to(positions)
        towards.append(torch.nn.functional.normalize(camera - positions, dim=1))
        sums.append(_sums(state, inputs, view))
    radiance, pixels, clipped, normal = torch.stack(sums, dim=1).cpu().split([3, 1, 1, 3], dim=2)
    towards = torch.stack(towards, dim=1).cpu()
    pixels, clipped = pixels[..., 0], clipped[..., 0]
    mean = radiance.sum(dim=1) / pixels.sum(dim=1, keepdim=True).clamp_min(1e-6)
    some, normal = pixels.clamp_min(1e-6), torch.nn.functional.normalize(normal, dim=2)
    known = (pixels > LEAST_PIXELS) & (clipped < LEAST_CLIPPED * some) & ((normal * towards).sum(dim=2) > GRAZING)
    return Seen(radiance / some[..., None], pixels * known, pixels.sum(dim=1), mean, normal, towards)


def _sums(state: State, inputs: RenderInputs, view: int) -> Tensor:
    """Sum over each surfel's pixels in a photo (N, 8): linear radiance, weights, those of clipped pixels, and blended normals."""
    photo, exposure = state.photo(view), state.exposure(view)
    radiance = linear(photo)
    radiance = radiance if exposure is None else radiance / exposure
    one = torch.ones_like(radiance[..., :1])
    clipped = photo.clipped.any(dim=-1, keepdim=True).float()
    shown = torch.cat([radiance, one, clipped, probe.picture(state, view, inputs).normal], dim=-1)
    features = torch.ones_like(inputs.surfels.positions[:, :1]).expand(-1, 8)
    return probe.pixel_sums(inputs.surfels, photo, state.near, features, lambda _: shown)


def _mirrored(
    state: State, surfels: Surfels, seen: Seen, light: Environment, turns: list[Tensor]
) -> Iterator[list[Tensor]]:
    """Yield for each photo what the surfels mirror there, as one tensor (N, 3) for each of ROUGHNESSES."""
    levels, occluder, there = cubemap.in_texel_order(light.levels, light.sides), state.occluder, None
    if occluder is not None:
        mesh = occluder.mesh
        weights = blend(
            surfels, seen.outward.double().numpy(), mesh.vertices, smooth_normals(mesh.vertices, mesh.faces)
        )
        there = torch.from_numpy(weights @ seen.mean.numpy())
    points = surfels.positions.double().numpy()
    for view, turn in enumerate(turns):
        normal = seen.normal[:, view]
        direction = mirror(-seen.towards[:, view], normal)
        levels_of = (torch.full((len(normal),), float(prefilter.level_of(roughness))) for roughness in ROUGHNESSES)
        shown = [cubemap.sample(levels, light.sides, direction @ turn.T, level) for level in levels_of]
        if there is not None:
            face, inside = occluder.meet(points, normal.double().numpy(), direction.double().numpy())
            met = face >= 0
            corners = there[torch.from_numpy(mesh.faces[face[met]]).long()]
            radiance = (corners * torch.from_numpy(inside[met])[..., None]).sum(dim=1)
            for each in shown:
                each[torch.from_numpy(met)] = radiance
        yield [each.clamp_max(BRIGHTEST) for each in shown]


def _fit(seen: Seen, mirrored: Iterable[list[Tensor]], positions: Tensor) -> Fit:
    """Fit both materials to all photos, for each of ROUGHNESSES, and keep the best of each kind.

    With reflectance s and diffuse radiance c, a metal shows (s FG0 + FG1) R and paint c + F R of what it mirrors, R: FG0, FG1 and F are the
    entries 0, 1 and 3 of `brdf.reflectance_table`. Sums over photos suffice for both.
    """
    near, count = neighbours(positions, NEIGHBOURS), len(positions)
    sums = {
        name: torch.zeros(len(ROUGHNESSES), count, 3, dtype=torch.double)
        for name in ("rest", "both", "power", "paint", "first")
    }
    changes = torch.zeros(
        count, 4, dtype=torch.double
    )  # weighted sums of the mirrored, the shown, their product and the mirrored's square
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
    return Fit(ratio.float(), slope.float(), mean.float(), roughness, weighed[:, 3] > SEEN)
