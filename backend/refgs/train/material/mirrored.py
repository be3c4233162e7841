"""Compare what photos show of each surfel with what it mirrors: as a metal, and as paint.

A metal shows what it mirrors, times its reflectance. Paint shows its diffuse radiance, the same in all photos, and about 4 % of what it
mirrors. Both are fitted to some photos by least squares. A surfel mirrors the light learned so far or, where its mirror ray meets the
object, the mean radiance that photos show there. So the material of the mirrored surface need not be known.

In a dark room, the light is learned too bright where it is dark. Then black paint explains a metal as well. So both are also fitted to the
photos alone in which the mirror ray meets the object: these do not depend on the light.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import smooth_normals
from refgs.geometry.visibility import Occluder, mirror
from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.brdf import look_up
from refgs.render.relight import blend
from refgs.train import probe
from refgs.train.material.observe import GRAZING, OBSERVED_VIEWS, Seen, observe_mirrored, pooled
from refgs.train.state import State

ROUGHNESSES = 0.05, 0.2, 0.45  # roughnesses that are tried
TOLERANCE = 0.15  # fraction of the radiance: smaller errors of either kind tell nothing
BRIGHTEST = 20.0  # largest radiance of a mirrored lamp: photos clip it
MIDDLE = 1  # index of the roughness by which changes are compared


class Fit(NamedTuple):
    """Hold how well metal and paint explain what some photos show of each of N surfels and its neighbours.

    - `ratio` (N,): the logarithm of the squared error as a metal, divided by that as paint
    - `reflectance` (N, 3), `roughness` (N,): values of the metal that fits best; its reflectance is a mean over the neighbours
    - `mirrored` (N,): the mean radiance that they mirror
    - `pixels` (N,): their pixels in these photos
    - `reflected`, `white` (N, 3): what they show in all of these photos together, and what a metal of reflectance 1 would show. Where
      normals err, `reflectance` is too low: surfels mirror other points than their rays meet. Together they mirror the same, so that sums
      tell more.
    """

    ratio: Tensor
    reflectance: Tensor
    roughness: Tensor
    mirrored: Tensor
    pixels: Tensor
    reflected: Tensor
    white: Tensor


class Mirrored(NamedTuple):
    """Hold the fits to all photos, and to those in which the mirror ray meets the object.

    `radiance` (N, V) is what each surfel mirrors in each photo: the mean of the channels, at the roughness MIDDLE. `met` (N, V) tells
    whether that is the object.
    """

    everywhere: Fit
    of_object: Fit
    radiance: Tensor
    met: Tensor


@torch.no_grad()
def observe_both(
    state: State, occluder: Occluder | None
) -> tuple[Surfels, Seen, Iterator[tuple[list[Tensor], Tensor]]]:
    """Observe the surfels in some training photos, and what they mirror (see `_mirrored`). All results are on the CPU.

    The state must have a light. Without a mesh (`occluder`), surfels are taken to mirror the light alone, and not the object.
    """
    photos = probe.spread_views(state, OBSERVED_VIEWS)
    inputs = state.inputs()
    inputs = inputs._replace(surfels=Surfels(*(value.detach() for value in inputs.surfels)))
    seen = observe_mirrored(state, inputs, photos)
    surfels = Surfels(*(value.cpu() for value in inputs.surfels))
    turns = [torch.from_numpy(inputs.light.turn(state.photo(view).camera)).float() for view in photos]
    light = Environment(inputs.light.radiance.cpu())
    return surfels, seen, _mirrored(surfels, seen, occluder, light, turns)


def _mirrored(
    surfels: Surfels, seen: Seen, occluder: Occluder | None, light: Environment, turns: list[Tensor]
) -> Iterator[tuple[list[Tensor], Tensor]]:
    """Yield, for each photo, the linear radiance that the surfels mirror towards its camera: a tensor (N, 3) for each of ROUGHNESSES.

    Also yields the mask (N,) of surfels whose mirror ray meets the object.

    `turns` has a rotation matrix (3, 3) for each photo. It turns directions in the run's frame into those in which `light` is sampled.
    """
    levels, points = cubemap.in_texel_order(light.levels, light.sides), surfels.positions.double().numpy()
    there = torch.zeros(0, 3) if occluder is None else _at_vertices(surfels, seen, occluder.mesh)
    for turn, normal, towards in zip(turns, seen.normal.unbind(dim=1), seen.towards.unbind(dim=1), strict=True):
        direction = mirror(-towards, normal)
        levels_of = (torch.full((len(points),), float(prefilter.level_of(roughness))) for roughness in ROUGHNESSES)
        shown = [cubemap.sample(levels, light.sides, direction @ turn.T, level) for level in levels_of]
        of_object = torch.zeros(len(points), dtype=torch.bool)
        if occluder is not None:
            face, inside = occluder.meet(points, normal.double().numpy(), direction.double().numpy())
            met = face >= 0
            of_object = torch.from_numpy(met)
            corners = there[torch.from_numpy(occluder.mesh.faces[face[met]]).long()]
            radiance = (corners * torch.from_numpy(inside[met])[..., None]).sum(dim=1)
            for each in shown:
                each[of_object] = radiance
        yield [each.clamp_max(BRIGHTEST) for each in shown], of_object


def _at_vertices(surfels: Surfels, seen: Seen, mesh: Mesh) -> Tensor:
    """Return the mean radiance (M, 3) that photos show at the vertices of a mesh."""
    normals = smooth_normals(mesh.vertices, mesh.faces)
    return torch.from_numpy(blend(surfels, seen.outward.double().numpy(), mesh.vertices, normals) @ seen.mean.numpy())


class _Sums:
    """Add up, over photos, what the fits of metal and of paint need of N surfels.

    Let R be what a surfel mirrors. A metal of reflectance s shows (s FG0 + FG1) R. Paint of diffuse radiance c shows c + F R. FG0, FG1
    and F are the channels 0, 1 and 3 of `brdf.reflectance_table`. Both fits need only sums over the photos.
    """

    def __init__(self, count: int, roughnesses: tuple[float, ...]) -> None:
        self._roughnesses = roughnesses
        names, shape = ("shown", "light", "rest", "both", "power", "paint", "first"), (len(roughnesses), count, 3)
        self._sums = {name: torch.zeros(shape, dtype=torch.double) for name in names}
        # Sums of weights, the mirrored, the shown, and its square.
        self._whole = torch.zeros(count, 8, dtype=torch.double)

    def add(self, weight: Tensor, shown: Tensor, mirrored: list[Tensor], cosine: Tensor) -> None:
        """Add one photo: weights (N,), linear radiance (N, 3), what is mirrored at each of ROUGHNESSES (N, 3), cosines (N,)."""
        weight = weight[:, None]
        for index, (roughness, light) in enumerate(zip(self._roughnesses, mirrored, strict=False)):
            first, second, _, coat = look_up(cosine, torch.full_like(cosine, roughness)).unsqueeze(2).unbind(dim=1)
            rest, reflected, dull = shown - second * light, first * light, shown - coat * light
            self._sums["shown"][index] += weight * rest
            self._sums["light"][index] += weight * reflected
            self._sums["rest"][index] += weight * rest.square()
            self._sums["both"][index] += weight * rest * reflected
            self._sums["power"][index] += weight * reflected.square()
            self._sums["paint"][index] += weight * dull.square()
            self._sums["first"][index] += weight * dull
        light = mirrored[MIDDLE].mean(dim=1, keepdim=True)
        self._whole += weight * torch.cat([torch.ones_like(light), light, shown, shown.square()], dim=1)

    def fit(self, near: Tensor, by_power: bool) -> Fit:
        """Keep each surfel's best metal and best paint. Errors are added up over the neighbours `near` (N, K).

        With `by_power`, a surfel counts for the mean reflectance by the square of what it mirrors. That is best where the mirrored radiance
        is known, as that of the object. A lamp's is not, because photos clip it.
        """
        sums, (total, light, mean, square) = self._sums, self._whole.split([1, 1, 3, 3], dim=1)
        some = total.clamp_min(1e-6)
        reflectance = (sums["both"] / sums["power"].clamp_min(1e-12)).clamp(0, 1)
        metal = (sums["rest"] - 2 * reflectance * sums["both"] + reflectance.square() * sums["power"]).sum(dim=2)
        diffuse = (sums["first"] / some).clamp_min(0)
        paint = (sums["paint"] - 2 * diffuse * sums["first"] + diffuse.square() * total).sum(dim=2)
        steady = (square - mean.square() / some).sum(dim=1)  # paint that mirrors nothing
        errors = torch.cat([metal, paint, steady[None], TOLERANCE**2 * square.sum(dim=1)[None]]).clamp_min(0)
        errors = pooled(errors.T.float(), near)
        metal, paint, least = errors.split([len(metal), len(paint) + 1, 1], dim=1)
        ratio = (metal.amin(dim=1) + least[:, 0]) / (paint.amin(dim=1) + least[:, 0]).clamp_min(1e-12)
        best = metal.argmin(dim=1)
        rows = best, torch.arange(len(best))
        weight = sums["power"][rows] if by_power else total.expand(-1, 3)
        columns = reflectance[rows] * weight, weight, sums["shown"][rows], sums["light"][rows], light, total
        summed = pooled(torch.cat(columns, dim=1).float(), near)
        chosen, weight, shown, white, light, pixels = summed.split([3, 3, 3, 3, 1, 1], dim=1)
        chosen, light = chosen / weight.clamp_min(1e-12), light / pixels.clamp_min(1e-6)
        rough = torch.tensor(self._roughnesses)[best]
        values = ratio.clamp_min(1e-12).log(), chosen, rough, light[:, 0], pixels[:, 0], shown, white
        return Fit(*(each.float() for each in values))


def fit_both(seen: Seen, mirrored: Iterable[tuple[list[Tensor], Tensor]], near: Tensor) -> Mirrored:
    """Fit metal and paint to all photos, and to those in which the mirror ray meets the object.

    `mirrored` are the yields of `_mirrored`. `near` (N, K) are the neighbours to average over.
    """
    # The radiance of the object is not blurred, so that one roughness is enough there.
    everywhere, of_object, radiance, all_met = _Sums(len(near), ROUGHNESSES), _Sums(len(near), ROUGHNESSES[:1]), [], []
    for view, (lights, met) in enumerate(mirrored):
        weight, shown = seen.weight[:, view], seen.radiance[:, view]
        cosine = (seen.normal[:, view] * seen.towards[:, view]).sum(dim=1).clamp(GRAZING, 1)
        everywhere.add(weight, shown, lights, cosine)
        of_object.add(weight * met, shown, lights, cosine)
        radiance.append(lights[MIDDLE].mean(dim=1))
        all_met.append(met)
    views = (torch.stack(each, dim=1) for each in (radiance, all_met))
    return Mirrored(everywhere.fit(near, False), of_object.fit(near, True), *views)
