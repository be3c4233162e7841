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
    whether that is the object. Where a photo does not show a surfel, both are 0.
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
    """Yield, for each photo, the linear radiance that the M surfels in it mirror towards its camera: (M, 3) for each of ROUGHNESSES.

    Also yields the mask (M,) of surfels whose mirror ray meets the object.

    `turns` has a rotation matrix (3, 3) for each photo. It turns directions in the run's frame into those in which `light` is sampled.
    """
    levels = cubemap.in_texel_order(light.levels, light.sides)
    there = torch.zeros(0, 3) if occluder is None else _at_vertices(surfels, seen, occluder.mesh)
    for view, turn in enumerate(turns):
        rows = seen.in_photo(view)
        normal = seen.normal[rows, view]
        direction = mirror(-seen.towards[rows, view], normal)
        levels_of = (torch.full((len(rows),), float(prefilter.level_of(roughness))) for roughness in ROUGHNESSES)
        shown = [cubemap.sample(levels, light.sides, direction @ turn.T, level) for level in levels_of]
        of_object = torch.zeros(len(rows), dtype=torch.bool)
        if occluder is not None:
            points = surfels.positions[rows].double().numpy()
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
    """Hold what a fit needs of one photo, of the surfels `rows` (M,) alone that it shows.

    `weight` (M,) is that of `Seen`, `shown` (M, 3) the linear radiance, `clipped` (M, 3) where the photo is clipped. `mirrored` (M, 3) is
    what is mirrored at each of the first of ROUGHNESSES. `tables` (M, 4, 1) are `brdf.reflectance_table` there.
    """

    rows: Tensor
    weight: Tensor
    shown: Tensor
    clipped: Tensor
    mirrored: list[Tensor]
    tables: list[Tensor]

    @classmethod
    def of(cls, seen: Seen, view: int, mirrored: list[Tensor]) -> "_Photo":
        rows = seen.in_photo(view)
        weight, shown, clipped, normal, towards = (
            each[rows, view] for each in (seen.weight, seen.radiance, seen.clipped, seen.normal, seen.towards)
        )
        cosine = (normal * towards).sum(dim=1).clamp(GRAZING, 1)
        tables = [look_up(cosine, torch.full_like(cosine, roughness))[..., None] for roughness in ROUGHNESSES]
        return cls(rows, weight, shown, clipped, mirrored, tables)

    def part(self, which: Tensor, kinds: int) -> "_Photo":
        """Return what those that the mask `which` (M,) selects show, and what is mirrored at the first `kinds` roughnesses."""
        rows, weight, shown, clipped = (each[which] for each in self[:4])
        return _Photo(rows, weight, shown, clipped, *([each[which] for each in many[:kinds]] for many in self[4:]))

    def models(self) -> tuple[Tensor, Tensor]:
        """Return linear models, (H, M, 3) each: a model shows the first + value · the second, with one unknown value a channel.

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


def _solve(photos: list[_Photo], count: int, kinds: int) -> tuple[Tensor, Tensor, Tensor]:
    """Fit each model to the photos by least squares. Return values and power (H, N, 3), and errors (H, N). N is `count`.

    Where a photo is clipped, a model may be brighter: its error is one-sided. Were such photos left out, only the dark ones of a shiny
    metal would be left, and they look like paint. Errors are piecewise quadratic in the values, so Newton's method solves for these.
    """
    # Reflectance is at most 1, and the diffuse radiance of paint has no limit.
    most = torch.tensor([1.0] * kinds + [torch.inf] * (kinds + 1)).view(-1, 1, 1)
    value, shape = None, (len(most), count, 3)
    power, both, rest = (torch.zeros(shape) for _ in range(3))
    for _ in range(NEWTON_STEPS):
        for each in power, both, rest:
            each.zero_()
        for photo in photos:
            offset, slope = photo.models()
            over = photo.shown - offset
            free = photo.clipped if value is None else photo.clipped & (value[:, photo.rows] * slope > over)
            counts = photo.weight[:, None] * ~free
            power.index_add_(1, photo.rows, counts * slope.square())
            both.index_add_(1, photo.rows, counts * slope * over)
            rest.index_add_(1, photo.rows, counts * over.square())
        solved = (both / power.clamp_min(1e-12)).clamp_min(0).minimum(most)
        value = solved if value is None else torch.where(power > 0, solved, value)
    assert value is not None
    return value, power, (rest - 2 * value * both + value.square() * power).sum(dim=2)


def _fit(photos: list[_Photo], kinds: int, near: Tensor, by_power: bool) -> Fit:
    """Keep each surfel's best metal and best paint. Errors are added up over the neighbours `near` (N, K).

    With `by_power`, a surfel counts for the mean reflectance by the square of what it mirrors. That is best where the mirrored radiance
    is known, as that of the object. A lamp's is not, because photos clip it.
    """
    value, power, errors = _solve(photos, len(near), kinds)
    square = torch.zeros(len(near), 3)
    for photo in photos:
        square.index_add_(0, photo.rows, photo.weight[:, None] * photo.shown.square())
    errors = pooled(torch.cat([errors, TOLERANCE**2 * square.sum(dim=1)[None]]).clamp_min(0).T, near)
    metal, paint, least = errors.split([kinds, kinds + 1, 1], dim=1)
    ratio = (metal.amin(dim=1) + least[:, 0]) / (paint.amin(dim=1) + least[:, 0]).clamp_min(1e-12)
    best = metal.argmin(dim=1)
    # Sums of the shown, of what white would show, and of weights, where no channel is clipped, and of all weights.
    whole = torch.zeros(len(best), 8)
    for photo in photos:
        (offset, slope), exact = photo.models(), ~photo.clipped.any(dim=1, keepdim=True)
        model = best[photo.rows], torch.arange(len(photo.rows))
        columns = exact * (photo.shown - offset[model]), exact * slope[model], exact, torch.ones_like(exact)
        whole.index_add_(0, photo.rows, photo.weight[:, None] * torch.cat(columns, dim=1))
    rows = best, torch.arange(len(best))
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
    photos, of_object = [], []
    radiance, all_met = torch.zeros_like(seen.weight), torch.zeros_like(seen.weight, dtype=torch.bool)
    for view, (lights, met) in enumerate(mirrored):
        photo = _Photo.of(seen, view, lights)
        photos.append(photo)
        # The radiance of the object is not blurred, so that one roughness is enough there.
        of_object.append(photo.part(met, 1))
        radiance[photo.rows, view], all_met[photo.rows, view] = lights[MIDDLE].mean(dim=1), met
    return Mirrored(_fit(photos, len(ROUGHNESSES), near, False), _fit(of_object, 1, near, True), radiance, all_met)
