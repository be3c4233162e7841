"""Compare what photos show of each surfel with what it mirrors: as a metal, and as paint.

A metal shows what it mirrors, times its reflectance. Paint shows its diffuse radiance, the same in all photos, and about 4 % of what it
mirrors. Both are fitted to some photos by least squares. A surfel mirrors the light learned so far or, where its mirror ray meets the
object, the mean radiance that photos show there. So the material of the mirrored surface need not be known.

In a dark room, the light is learned too bright where it is dark. Then black paint explains a metal as well. So both are also fitted to the
photos alone in which the mirror ray meets the object: these do not depend on the light.

Photos clip the highlights of metals more often than anything else. There, a surfel is at least as bright as the photo: a model that is
brighter has no error.
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
NEWTON_STEPS = 3


class Fit(NamedTuple):
    """Hold how well metal and paint explain what some photos show of each of N surfels and its neighbours.

    - `ratio` (N,): the logarithm of the squared error as a metal, divided by that as paint
    - `reflectance` (N, 3), `roughness` (N,): values of the metal that fits best; its reflectance is a mean over the neighbours
    - `pixels`, `exact` (N,): their pixels in these photos, and those where the photo is not clipped
    - `reflected`, `white` (N, 3): what these show together, and what a metal of reflectance 1 would show. Where normals err,
      `reflectance` is too low: surfels mirror other points than their rays meet. Together they mirror the same, so that sums tell more.
    """

    ratio: Tensor
    reflectance: Tensor
    roughness: Tensor
    pixels: Tensor
    exact: Tensor
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


class _Photo(NamedTuple):
    """Hold what a fit needs of one photo: `weight` (N,), linear radiance `shown`, and whether it is `clipped` (N, 3).

    `mirrored` (N, 3) is what is mirrored at each of the first of ROUGHNESSES. `tables` (N, 4, 1) are `brdf.reflectance_table` there.
    """

    weight: Tensor
    shown: Tensor
    clipped: Tensor
    mirrored: list[Tensor]
    tables: list[Tensor]

    @classmethod
    def of(cls, seen: Seen, view: int, mirrored: list[Tensor]) -> "_Photo":
        cosine = (seen.normal[:, view] * seen.towards[:, view]).sum(dim=1).clamp(GRAZING, 1)
        tables = [look_up(cosine, torch.full_like(cosine, roughness))[..., None] for roughness in ROUGHNESSES]
        return cls(seen.weight[:, view], seen.radiance[:, view], seen.clipped[:, view], mirrored, tables)

    def part(self, which: Tensor, kinds: int) -> "_Photo":
        """Return what the surfels `which` (N,) show, and what is mirrored at the first `kinds` roughnesses."""
        return self._replace(weight=self.weight * which, mirrored=self.mirrored[:kinds], tables=self.tables[:kinds])

    def models(self) -> tuple[Tensor, Tensor]:
        """Return linear models, (H, N, 3) each: a model shows the first + value · the second, with one unknown value a channel.

        Let R be what a surfel mirrors. A metal of reflectance s shows (s FG0 + FG1) R. Paint of diffuse radiance c shows c + F R. FG0, FG1
        and F are the channels 0, 1 and 3 of the table. The models are a metal for each roughness, paint for each roughness, and paint that
        mirrors nothing.
        """
        each = [*zip(self.tables, self.mirrored, strict=True)]
        one = torch.ones_like(self.shown)
        metal = [(table[:, 1] * light, table[:, 0] * light) for table, light in each]
        paint = [(table[:, 3] * light, one) for table, light in each]
        offset, slope = zip(*metal, *paint, (torch.zeros_like(one), one), strict=True)
        return torch.stack(offset), torch.stack(slope)


def _solve(photos: list[_Photo], kinds: int) -> tuple[Tensor, Tensor, Tensor]:
    """Fit each model to the photos by least squares. Return values and power (H, N, 3), and errors (H, N).

    Where a photo is clipped, a model may be brighter: its error is one-sided. Were such photos left out, only the dark ones of a shiny
    metal would be left, and they look like paint. Errors are piecewise quadratic in the values, so Newton's method solves for these.
    """
    # Reflectance is at most 1, and the diffuse radiance of paint has no limit.
    most = torch.tensor([1.0] * kinds + [torch.inf] * (kinds + 1)).view(-1, 1, 1)
    value, shape = None, (len(most), *photos[0].shown.shape)
    power, both, rest = (torch.zeros(shape) for _ in range(3))
    for _ in range(NEWTON_STEPS):
        for each in power, both, rest:
            each.zero_()
        for photo in photos:
            offset, slope = photo.models()
            over = photo.shown - offset
            free = photo.clipped if value is None else photo.clipped & (value * slope > over)
            counts = photo.weight[:, None] * ~free
            power += counts * slope.square()
            both += counts * slope * over
            rest += counts * over.square()
        solved = (both / power.clamp_min(1e-12)).clamp_min(0).minimum(most)
        value = solved if value is None else torch.where(power > 0, solved, value)
    assert value is not None
    return value, power, (rest - 2 * value * both + value.square() * power).sum(dim=2)


def _fit(photos: list[_Photo], kinds: int, near: Tensor, by_power: bool) -> Fit:
    """Keep each surfel's best metal and best paint. Errors are added up over the neighbours `near` (N, K).

    With `by_power`, a surfel counts for the mean reflectance by the square of what it mirrors. That is best where the mirrored radiance
    is known, as that of the object. A lamp's is not, because photos clip it.
    """
    value, power, errors = _solve(photos, kinds)
    square = torch.stack([(photo.weight[:, None] * photo.shown.square()).sum(dim=1) for photo in photos]).sum(dim=0)
    errors = pooled(torch.cat([errors, TOLERANCE**2 * square[None]]).clamp_min(0).T, near)
    metal, paint, least = errors.split([kinds, kinds + 1, 1], dim=1)
    ratio = (metal.amin(dim=1) + least[:, 0]) / (paint.amin(dim=1) + least[:, 0]).clamp_min(1e-12)
    best = metal.argmin(dim=1)
    rows = best, torch.arange(len(best))
    # Sums of the shown, of what white would show, and of weights, where no channel is clipped, and of all weights.
    whole = torch.zeros(len(best), 8)
    for photo in photos:
        (offset, slope), exact = photo.models(), ~photo.clipped.any(dim=1, keepdim=True)
        columns = exact * (photo.shown - offset[rows]), exact * slope[rows], exact, torch.ones_like(exact)
        whole += photo.weight[:, None] * torch.cat(columns, dim=1)
    weight = power[rows] if by_power else whole[:, 7:].expand(-1, 3)
    summed = pooled(torch.cat([value[rows] * weight, weight, whole], dim=1), near)
    chosen, weight, shown, white, exact, pixels = summed.split([3, 3, 3, 3, 1, 1], dim=1)
    rough = torch.tensor(ROUGHNESSES)[best]
    reflectance = chosen / weight.clamp_min(1e-12)
    return Fit(ratio.clamp_min(1e-12).log(), reflectance, rough, pixels[:, 0], exact[:, 0], shown, white)


def fit_both(seen: Seen, mirrored: Iterable[tuple[list[Tensor], Tensor]], near: Tensor) -> Mirrored:
    """Fit metal and paint to all photos, and to those in which the mirror ray meets the object.

    `mirrored` are the yields of `_mirrored`. `near` (N, K) are the neighbours to average over.
    """
    photos, radiance, all_met = [], [], []
    for view, (lights, met) in enumerate(mirrored):
        photos.append(_Photo.of(seen, view, lights))
        radiance.append(lights[MIDDLE].mean(dim=1))
        all_met.append(met)
    kinds = len(ROUGHNESSES)
    # The radiance of the object is not blurred, so that one roughness is enough there.
    of_object = [photo.part(met, 1) for photo, met in zip(photos, all_met, strict=True)]
    views = (torch.stack(each, dim=1) for each in (radiance, all_met))
    return Mirrored(_fit(photos, kinds, near, False), _fit(of_object, 1, near, True), *views)
