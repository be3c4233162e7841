"""Shade blended maps, or single surfels, by the split sum. Differentiable."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels import cuda, load
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment
from refgs.render.brdf import reflectance_table

CHANNELS = 11  # normal, albedo, metallic, roughness, position; optional channels come before the position
INDIRECT = 6  # additional channels with inter-reflection
MATTE = 6  # without specular shading: normal and albedo


class Shaded(NamedTuple):
    """Hold a shaded picture and the maps of its pixels. The maps are zero where nothing is.

    - `color` (H, W, 3): the picture over the background, sRGB-encoded
    - `normal` (H, W, 3): blended, not normalised
    - `material` (H, W, 5): albedo, metallic, roughness
    - `radiance` (H, W, 3): linear, without the background; not differentiable
    """

    color: Tensor
    normal: Tensor
    material: Tensor
    radiance: Tensor


class _Work(struct("Shade", "pixels.h")):
    @classmethod
    def of(cls, features: Tensor, alpha: Tensor, camera: Camera) -> "_Work":
        height, width, channels = features.shape
        work = cls(width=width, height=height, channels=channels, chunk_rows=max(32, -(-height // 16)))
        work.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        work.fx, work.fy, work.cx, work.cy = camera.fx, camera.fy, camera.cx, camera.cy
        work.attach(features=features, alpha=alpha)
        return work

    @property
    def chunks(self) -> int:
        return -(-self.height // self.chunk_rows)


class _Padding(NamedTuple):
    """Hold index tables for cubemaps whose faces get a border one texel wide, so that bilinear look-up has no seams.

    Each position of a face with its border is a cell. A row of cells is a line. Several cells can hold the same texel, because borders are
    copies. Texels are in orbit order (`cubemap.orbit_order`).

    - `texel`: the texel that each cell holds
    - `cell`, `starts`: the cells that hold texel i are `cell[starts[i] : starts[i + 1]]`
    - `first_cells`, `first_lines`: the first cell and the first line of each cubemap in the stack
    - `lines`: the number of lines
    """

    texel: Tensor
    starts: Tensor
    cell: Tensor
    first_cells: list[int]
    first_lines: list[int]
    lines: int

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, sides: tuple[int, ...], device: torch.device) -> "_Padding":
        texel, first_cells, _ = cubemap.padded(sides)
        texel = cubemap.orbit_order(sides).argsort()[texel]
        lines = [6 * (side + 2) for side in sides]
        starts = torch.nn.functional.pad(texel.bincount().cumsum(dim=0), (1, 0))
        texel, starts, cell = (t.to(device, torch.int32) for t in (texel, starts, texel.argsort(stable=True)))
        return cls(texel, starts, cell, first_cells.tolist(), [sum(lines[:k]) for k in range(len(lines))], sum(lines))


@lru_cache(maxsize=4)
def _reflectance(device: torch.device) -> Tensor:
    return reflectance_table().to(device)


@lru_cache(maxsize=4)
def _one(device: torch.device) -> Tensor:
    return torch.ones(3, device=device)


@timed("shading")
class _Shade(Function):
    @staticmethod
    def forward(ctx, features, alpha, levels, exposure, sides, camera, turn, background, visibility, *how):
        features, alpha = features.contiguous(), alpha.contiguous()
        table, padding = _reflectance(features.device), _Padding.of(sides, features.device)
        light, cells = levels.contiguous(), len(padding.texel)
        padded = features.new_empty(cells, 4)
        work = _Work.of(features, alpha, camera)
        background = background.to(features)
        work.turn[:] = turn.reshape(-1).tolist()
        work.attach(background=background, exposure=exposure, reflectance=table)
        work.attach(light=light, padded=padded)
        work.attach(texel=padding.texel, starts=padding.starts, cell=padding.cell)
        if visibility is not None:
            work.attach(visibility=visibility)
        work.harmonics, work.display, work.mirror, work.matte, work.splats = how
        work.texels, work.cells, work.lines = len(light), cells, padding.lines
        work.levels.count, work.levels.cells = len(sides), padded.data_ptr()
        work.levels.side[: len(sides)] = sides
        work.levels.start[: len(sides)], work.levels.line[: len(sides)] = padding.first_cells, padding.first_lines
        work.levels.alpha[: len(prefilter.ROUGHNESS)] = [roughness**2 for roughness in prefilter.ROUGHNESS]
        work.reflectance_side = table.shape[0]
        numbers = (3, 0, 0, 0) if work.splats else (3, 3, 5, 3)
        shaded = Shaded(*(features.new_empty(*alpha.shape, n) for n in numbers))
        work.attach(**shaded._asdict())
        load.run("refgs_shade_pad", work, features, items=cells)
        load.run("refgs_shade_forward", work, features, items=alpha.numel())
        ctx.save_for_backward(features, alpha)
        ctx.work, ctx.kept = work, (padded, background, exposure, visibility, table, padding)
        ctx.mark_non_differentiable(shaded.radiance)
        ctx.set_materialize_grads(False)
        return tuple(shaded)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_color, by_normal, by_material, _):
        features, alpha = ctx.saved_tensors
        work, new = ctx.work, features.new_empty
        upstream = {"by_color": (by_color, 3)}
        if not work.splats:
            upstream |= {"by_normal": (by_normal, 3), "by_material": (by_material, 5)}
        given = {n: new(*alpha.shape, c).zero_() if v is None else v.contiguous() for n, (v, c) in upstream.items()}
        by_features, by_alpha, by_light = torch.empty_like(features), torch.empty_like(alpha), new(work.texels, 3)
        work.attach(**given, by_features=by_features, by_alpha=by_alpha, by_light=by_light)
        if load.on_gpu(features):
            blocks = -(-alpha.numel() // cuda.BLOCK)
            by_exposure = new(blocks, 3)
            sizes = 4 * alpha.numel(), 3 * work.cells, 1
            map_sums, cell_sums, largest = new(sum(sizes), dtype=torch.int64).zero_().split(sizes)
            work.attach(by_exposure=by_exposure, map_sums=map_sums, cell_sums=cell_sums, largest=largest)
            cuda.launch("refgs_shade_largest", work, features.device, blocks)
            cuda.launch("refgs_shade_backward", work, features.device, blocks)
        else:
            by_exposure, rows = new(work.chunks, 3), work.chunk_rows + load.kernels().refgs_shade_halo()
            buffers = {
                "near": new(work.chunks, rows, work.width, 4),
                "by_cells": new(work.chunks + 1, work.cells, 4),
                "touched": new(work.chunks, rows + work.lines, dtype=torch.uint8),
            }
            work.attach(by_exposure=by_exposure, **buffers)
            load.parallel(load.kernels().refgs_shade_backward, work)
        load.run("refgs_shade_gather", work, features, items=alpha.numel())
        load.run("refgs_shade_unpad", work, features, items=work.texels)
        return by_features, by_alpha, by_light, by_exposure.sum(dim=0), *[None] * 10


def mirror_directions(features: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Compute the mirror direction of each pixel (H, W, 3): the viewing direction reflected at the blended normal. No gradients.

    `shade` looks up the light in these directions. They are unit vectors in world space, and zero where nothing is. `features` (H, W, 17)
    and `alpha` (H, W) are the same as for `shade` with `visibility`. Raises ValueError for features of another shape.
    """
    if features.shape != (*alpha.shape, CHANNELS + INDIRECT):
        raise ValueError(f"expected {CHANNELS + INDIRECT} features a pixel, got {tuple(features.shape)}")
    features, alpha = features.detach().contiguous(), alpha.detach().contiguous()
    work, mirrored = _Work.of(features, alpha, camera), features.new_empty(*alpha.shape, 3)
    work.attach(mirrored=mirrored)
    load.run("refgs_shade_mirrored", work, features, items=alpha.numel())
    return mirrored


def shade(
    features: Tensor,
    alpha: Tensor,
    environment: Environment,
    camera: Camera,
    background: Tensor,
    visibility: Tensor | None = None,
    exposure: Tensor | None = None,
    display: bool = False,
    mirror: bool = False,
    by_direction: bool = False,
    matte: bool = False,
) -> Shaded:
    """Shade blended maps by the split sum (Ref-Gaussian paper, Eq. 5–10), over a background (3,), sRGB-encoded.

    `features` (H, W, C) are sums over the surfels of each pixel, weighted as in `rasterize`, in this order:

    - normal in world space (3), albedo (3), metallic, roughness
    - if `by_direction` is true: a view-dependent colour (3), which replaces diffuse shading, as in the Ref-Gaussian paper
    - if `visibility` is given and `by_direction` is false: irradiance divided by that of an unoccluded surface (3)
    - if `visibility` is given: radiance from the object itself (3), which replaces the environment's where `visibility` is 0 (Eq. 9)
    - position (3)

    The other arguments change the shading:

    - `visibility` (H, W): 0 where the object occludes the mirror direction, else 1; values between are allowed
    - `exposure` (3,), default 1: factors that multiply red, green and blue radiance before it is encoded
    - `display`: light and materials are display values in 0..1, so nothing is encoded
    - `mirror`: reflections are a sharp mirror image of the light, weighted by metallic (Ye et al., 3DGS-DR, 2024)
    - `matte`: `features` are normal and albedo only. The picture is albedo · irradiance / π, and its material has metallic 0, roughness 1.

    Blending biases normals towards the camera. This bias is removed first, by means of the position (see kernels/blended.h).

    All tensors are float32, on the CPU or on one CUDA card. Differentiable in `features`, `alpha`, the light and `exposure`. Results do not
    depend on the number of threads. A card returns the same bits each time. If any derivative is not finite, a card makes all NaN.
    """
    expected = MATTE if matte else CHANNELS + (3 * by_direction if visibility is None else INDIRECT)
    if features.shape != (*alpha.shape, expected):
        size = f"{alpha.shape[1]}×{alpha.shape[0]}"
        raise ValueError(f"expected {expected} features a pixel of {size}, got {tuple(features.shape)}")
    how = by_direction, display, mirror, matte, False
    return _shade(features, alpha, environment, camera, background, how, visibility, exposure)


def shade_splats(features: Tensor, environment: Environment, camera: Camera, mirror: bool = False) -> Tensor:
    """Shade each surfel before blending, by the split sum. Returns the radiance (N, 3) towards the camera.

    This is the initial stage of the Ref-Gaussian paper (§3.3).

    `features` (N, C) are, in this order:

    - normal in world space (3), albedo (3), metallic, roughness
    - if C is 14: a view-dependent colour (3), which replaces diffuse shading
    - position (3)

    If C is 6 they are normal and albedo only, and shading is diffuse. With `mirror`, reflections are a sharp mirror image of the light.
    Differentiable in `features` and the light.
    """
    count, channels = features.shape
    if channels not in (MATTE, CHANNELS, CHANNELS + 3):
        raise ValueError(f"expected {MATTE}, {CHANNELS} or {CHANNELS + 3} features a surfel, got {channels}")
    features, alpha = features[:, None], features.new_ones(count, 1)
    how = channels > CHANNELS, False, mirror, channels == MATTE, True
    return _shade(features, alpha, environment, camera, features.new_zeros(3), how).color[:, 0]


def _shade(
    features: Tensor,
    alpha: Tensor,
    light: Environment,
    camera: Camera,
    background: Tensor,
    how: tuple[bool, bool, bool, bool, bool],  # by direction, display, mirror, matte, of surfels
    visibility: Tensor | None = None,
    exposure: Tensor | None = None,
) -> Shaded:
    texels = sum(6 * side * side for side in light.sides)
    exposure = _one(features.device) if exposure is None else exposure
    given = {"features": (features, features.shape), "alpha": (alpha, alpha.shape), "exposure": (exposure, (3,))}
    given |= {"levels": (light.levels, (texels, 3))}
    load.check(**given, **({} if visibility is None else {"visibility": (visibility, alpha.shape)}))
    maps = features, alpha, light.levels, exposure
    return Shaded(*_Shade.apply(*maps, light.sides, camera, light.turn(camera), background, visibility, *how))
