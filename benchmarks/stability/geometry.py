"""Test the rasteriser, and other kernels that use positions, with extreme surfels and cameras."""

import dataclasses
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.stability import compare
from benchmarks.stability.cases import Case, Outcome
from refgs.camera import Camera
from refgs.model import harmonics
from refgs.render import reference
from refgs.render.directional import directional
from refgs.render.facing import facing_normals
from refgs.render.rasterize import rasterize
from tests.makers import scenes

WIDTH, HEIGHT, COUNT = 40, 28, 90


def camera(
    focal: float = 1.1, centre: tuple[float, float] | None = None, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Camera:
    """Make a rotated camera. `focal` is the focal length in image widths, `centre` the principal point in pixels."""
    return dataclasses.replace(scenes.camera(*size, centre), fx=focal * size[0], fy=focal * size[0])


def surfels(
    view: Camera,
    count: int = COUNT,
    pixels: tuple[float, float] = (0.5, 5.0),
    depth: tuple[float, float] = (1.0, 3.0),
    opacity: tuple[float, float] = (0.05, 1.0),
    aspect: float = 3.0,
    edge_on: float | None = None,
) -> list[Tensor]:
    """Make `count` surfels at random places in a camera's view. Return the rasteriser's input tensors.

    `pixels` is the range of the surfels' standard deviations in pixels, and `depth` the range of their depths. `aspect` is the largest
    ratio of a surfel's two scales. Normals are random. If `edge_on` is given, surfels are seen edge-on instead; the angle is off by at most
    `edge_on` radians.
    """
    rng = np.random.default_rng(0)
    z = rng.uniform(*depth, count)
    at = rng.uniform(0, 1, (count, 2)) * [view.width, view.height]
    local = np.stack([(at[:, 0] - view.cx) / view.fx * z, (at[:, 1] - view.cy) / view.fy * z, z], axis=1)
    to_world = view.camera_to_world
    position = local @ to_world[:3, :3].T + to_world[:3, 3]
    size = np.exp(rng.uniform(*np.log(pixels), count)) * z / view.fx
    scale = size[:, None] * np.stack([np.ones(count), aspect ** -rng.uniform(0, 1, count)], axis=1)
    rotation = rng.normal(size=(count, 4))
    if edge_on is not None:
        sight = position - view.position
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        normal = np.cross(sight, rng.normal(size=(count, 3)))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal += rng.uniform(0, edge_on, (count, 1)) * sight
        rotation = np.stack([Rotation.align_vectors([n], [[0, 0, 1]])[0].as_quat(scalar_first=True) for n in normal])
    values = position, rotation, scale, rng.uniform(*opacity, count), rng.normal(size=(count, 4))
    return [torch.tensor(v, dtype=torch.float32) for v in values]


def moved(scale: float = 1.0, offset: float = 0.0) -> Outcome:
    """Multiply a scene and its camera by `scale`, then move both by `offset`. Compare the rasteriser with float64."""
    view = camera()
    position, rotation, size, *rest = surfels(view)
    pose = view.world_to_camera.copy()
    pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ np.full(3, offset)
    view = dataclasses.replace(view, world_to_camera=pose)
    return compare.raster([position * scale + offset, rotation, size * scale, *rest], view, near=0.1 * scale)


def seen(focal: float = 1.1, centre: tuple[float, float] | None = None, **how) -> Outcome:
    view = camera(focal, centre)
    return compare.raster(surfels(view, **how), view, near=min(0.1, 0.1 / focal))


def on_the_camera() -> Outcome:
    """Compare the rasteriser with float64. Some surfels lie at the camera's centre, some 1e-7 from it, some behind the camera."""
    view = camera()
    position, *rest = surfels(view)
    here = torch.from_numpy(view.position).float()
    position[:20] = here
    position[20:40] = here + 1e-7 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    position[40:50] = 2 * here - position[40:50]
    return compare.raster([position, *rest], view)


def towards_the_camera() -> Outcome:
    """Compare view-dependent colours and normals with float64. Surfels are 0, 1e-7, 1e-3, 1 and 1e5 away from the camera."""
    view, generator = camera(), torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator, dtype=torch.float64), dim=-1)
    distance = torch.tensor([0.0, 1e-7, 1e-3, 1.0, 1e5], dtype=torch.float64).repeat(60)[:, None]
    position = (torch.from_numpy(view.position) + distance * way).float()
    rotation = torch.randn(300, 4, generator=generator)
    rotation[::7] = 0
    constant, rest = torch.randn(300, 1, 3, generator=generator), torch.randn(300, 15, 3, generator=generator)
    leaves = [v.requires_grad_() for v in (constant, rest, rotation)]
    color, normal = directional(constant, rest, 0.5, position, view), facing_normals(rotation, position, view)
    by = torch.autograd.grad([color.sum(), normal.sum()], leaves)
    towards = torch.from_numpy(view.position) - position.double()
    exact = [v.detach().double().requires_grad_() for v in leaves]
    basis = harmonics.basis(-reference.unit(towards), 3)
    expected = (0.5 + torch.einsum("nk,nkc->nc", basis, torch.cat(exact[:2], dim=1))).clamp_min(0)
    column = reference.rotation_matrices(exact[2])[:, :, 2]
    along = (column * towards).sum(dim=-1)
    column = torch.where(along < -0.3 * towards.norm(dim=-1), -1.0, 1.0).detach()[:, None] * column
    kept = rotation.detach().norm(dim=-1) > 0  # the reference has no derivative there
    exact_by = torch.autograd.grad([expected.sum(), column[kept].sum()], exact)
    by = [*by[:2], torch.where(kept[:, None], by[2], 0)]
    return compare.outcome([color.detach(), normal.detach()], [expected.detach(), column.detach()], by, exact_by)


def across_near() -> Outcome:
    return compare.raster(scenes.surfels("across_near", 4), scenes.camera(), near=scenes.NEAR)


def coincident(count: int = 3000) -> Outcome:
    """Compare the rasteriser with float64 on `count` surfels that differ only in opacity and colour."""
    view = camera(size=(16, 12))
    one = surfels(view, 1, pixels=(3.0, 3.0), depth=(2.0, 2.0))
    generator = torch.Generator().manual_seed(0)
    geometry = [v.expand(count, *v.shape[1:]).contiguous() for v in one[:3]]
    return compare.raster(
        [*geometry, 0.02 * torch.rand(count, generator=generator), torch.randn(count, 4, generator=generator)], view
    )


def ties() -> Outcome:
    """Compare the rasteriser with float64 on surfels of exactly equal depth. They must be drawn in the order of their index."""
    view = dataclasses.replace(camera(), world_to_camera=np.eye(4))
    position, *rest = surfels(view)
    position[:, 2] = 2.0
    return compare.raster([position, *rest], view)


def one_pixel(count: int = 1_000_000) -> Outcome:
    """Compare the rasteriser with float64 on `count` surfels that all lie in one pixel and are smaller than it.

    In each pixel, the rasteriser measures the distance to the surfel's centre twice: in the surfel's plane, and in the image (the low-pass
    filter). It uses the smaller distance. If a surfel's centre lay exactly at the pixel's centre, both would be zero, and rounding would
    decide which is used. So no surfel lies there.
    """
    view = camera(size=(3, 3))
    _, rotation, scale, opacity, features = surfels(view, count, pixels=(0.01, 0.38), depth=(1.0, 1.0))
    depth = np.concatenate([np.linspace(1, 2, 20_000), np.linspace(2, 3, count - 20_000)])[:, None]
    at = np.random.default_rng(1).uniform(1.4, 1.6, (count, 2))  # even the closest pair is further apart than rounding
    way = np.concatenate([(at - [view.cx, view.cy]) / [view.fx, view.fy], np.ones((count, 1))], axis=1)
    position = torch.from_numpy(view.position + depth * way @ view.world_to_camera[:3, :3]).float()
    scale = (scale * torch.from_numpy(depth)).float()
    return compare.raster([position, rotation, scale, 0.05 * opacity, features], view, nearest=15_000)


def nothing() -> Outcome:
    """Check that a scene without surfels renders as an empty picture, and that the gradients have no rows."""
    view = camera()
    leaves = [v[:0].requires_grad_() for v in surfels(view)]
    maps = rasterize(*leaves, view, near=0.1)
    by = torch.autograd.grad(sum(m.sum() for m in maps), leaves)
    empty = [torch.zeros_like(v).double() for v in (*maps, *by)]
    return compare.outcome([m.detach() for m in maps], empty[:3], by, empty[3:])


DOUBLE = "projected in double precision, blended about each tile's middle"
FINE = 1e-5
EXACT = "float64, same input"


def _case(name: str, run, guard: str = DOUBLE, most: float = FINE, because: str = compare.FLOAT32) -> Case:
    return Case(f"raster: {name}", run, EXACT, most, because, guard)


CASES = [
    *(_case(f"scene scaled by {scale:g}", partial(moved, scale)) for scale in (1e-6, 1e-3, 1e3, 1e6)),
    _case("scene moved by 1e5", partial(moved, offset=1e5)),
    _case("edge-on to 1e-6 rad", partial(seen, edge_on=1e-6), "coefficients in two floats each; below a pixel, a dot of the screen filter"),
    _case("aspect 1e6", partial(seen, aspect=1e6)),
    _case("smaller than 1e-3 pixel", partial(seen, pixels=(1e-5, 1e-3)), "the screen filter draws it, half a pixel wide at the least"),
    _case("larger than the view", partial(seen, pixels=(100.0, 1e4), opacity=(0.02, 0.2))),
    _case("on the camera, and behind it", on_the_camera, "surfels nearer than the near plane are not drawn; their gradients are zero"),
    _case("across the near plane", across_near, "cut where rays meet them nearer than that plane"),
    _case("3,000 coincident", coincident, "drawn in their order"),
    _case("depth ties", ties, "drawn in their order"),
    _case("opacities near 0", partial(seen, opacity=(0.0, 0.006)), "below 1/255 not drawn"),
    _case("opacities near 1", partial(seen, opacity=(1 - 1e-7, 1.0)), "alpha at most 0.99, a pixel ends at transmittance 1e-4"),
    _case("no surfel", nothing, "an empty picture"),
    _case("one surfel", partial(seen, count=1)),
    _case("a million at one pixel", one_pixel, "a pixel ends at transmittance 1e-4"),
    *(_case(f"focal length {focal:g} widths", partial(seen, focal)) for focal in (1e-2, 1e2, 1e4)),
    _case("principal point ten widths outside", partial(seen, centre=(10.0 * WIDTH, -10.0 * HEIGHT))),
    Case("directions and normals: surfels 0 … 1e5 from the camera", towards_the_camera, EXACT, FINE, compare.FLOAT32, "no direction: zero"),
]  # fmt: skip
