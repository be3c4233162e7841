"""Maps to a picture: differentiable deferred shading."""

import ctypes
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.kernels.load import Shared, Work, kernels, parallel
from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment
from refgs.render.brdf import fg_table

CHANNELS = 11  # normal, albedo, metallic, roughness, position; before the position those that not every scene has


class Shaded(NamedTuple):
    """A picture (H, W, 3), sRGB-encoded, over the background; and what it was made of: blended normals (H, W, 3), not
    normalised, albedo, metallic and roughness (H, W, 5), linear radiance (H, W, 3) before the background: zero where
    nothing is. Differentiable but for the radiance."""

    color: Tensor
    normal: Tensor
    material: Tensor
    radiance: Tensor


class _Levels(ctypes.Structure):
    """`struct Levels` of light.h."""

    _fields_ = (
        ("count", ctypes.c_int64),
        ("side", ctypes.c_int32 * 8),
        ("start", ctypes.c_int32 * 8),
        ("roughness", ctypes.c_float * 8),
        ("texels", ctypes.c_void_p),
        ("padded", ctypes.c_void_p),
    )


class _Work(Work):
    """`struct Shade` of shade.cpp."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("width", "height", "channels", "chunk_rows")]
        + [("view", ctypes.c_double * 12)]
        + [(n, ctypes.c_double) for n in ("fx", "fy", "cx", "cy")]
        + [("background", ctypes.c_float * 3), ("harmonics", ctypes.c_int64)]
        + [(n, ctypes.c_void_p) for n in ("features", "alpha", "visibility")]
        + [("levels", _Levels), ("texels", ctypes.c_int64), ("irradiance", ctypes.c_void_p)]
        + [("fg", ctypes.c_void_p), ("fg_side", ctypes.c_int64)]
        + [(n, ctypes.c_void_p) for n in ("mirrored", "color", "normal", "material", "radiance")]
        + [(n, ctypes.c_void_p) for n in ("by_color", "by_normal", "by_material", "by_features", "by_alpha")]
        + [(n, ctypes.c_void_p) for n in ("halo", "by_chunk_texels", "by_irradiance", "by_levels")]
        + [("scratch", ctypes.c_void_p), ("shared", Shared)]
    )

    @classmethod
    def of(cls, features: Tensor, alpha: Tensor, camera: Camera) -> "_Work":
        """The work of one picture, with what all of its kernels read."""
        height, width, channels = features.shape
        work = cls(width=width, height=height, channels=channels, chunk_rows=max(32, -(-height // 16)))
        work.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        work.fx, work.fy, work.cx, work.cy = camera.fx, camera.fy, camera.cx, camera.cy
        work.attach(features=features, alpha=alpha)
        return work


@lru_cache(maxsize=4)
def _padded(sides: tuple[int, ...]) -> tuple[Tensor, list[int]]:
    texels, starts, _ = cubemap.padded(sides)
    return texels.to(torch.int32), starts.tolist()


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, alpha, levels, irradiance, sides, camera, background, visibility):
        features, alpha, irradiance = features.contiguous(), alpha.contiguous(), irradiance.contiguous()
        table, (padded, starts) = fg_table(), _padded(sides)
        quads = torch.nn.functional.pad(levels, (0, 1))
        work = _Work.of(features, alpha, camera)
        work.background[:] = background.tolist()
        work.attach(irradiance=irradiance, fg=table)
        if visibility is not None:
            work.attach(visibility=visibility)
        work.harmonics = work.channels > CHANNELS + 3 * (visibility is not None)
        work.levels.count, work.texels = len(sides), len(levels)
        work.levels.side[: len(sides)], work.levels.start[: len(sides)] = sides, starts
        work.levels.roughness[: len(sides)] = prefilter.ROUGHNESS
        work.levels.texels, work.levels.padded = quads.data_ptr(), padded.data_ptr()
        work.fg_side = table.shape[-1]
        shaded = Shaded(*(torch.empty(*alpha.shape, c) for c in (3, 3, 5, 3)))
        work.attach(**shaded._asdict())
        parallel(kernels().refgs_shade_forward, work)
        ctx.save_for_backward(features, alpha, irradiance)
        ctx.work, ctx.kept = work, (quads, visibility)
        ctx.mark_non_differentiable(shaded.radiance)
        return tuple(shaded)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_color, by_normal, by_material, _):
        features, alpha, irradiance = ctx.saved_tensors
        library, work = kernels(), ctx.work
        chunks = -(-work.height // work.chunk_rows)
        given = {"by_color": by_color.contiguous(), "by_normal": by_normal.contiguous()}
        given["by_material"] = by_material.contiguous()
        by_features, by_alpha = torch.empty_like(features), torch.empty_like(alpha)
        by_levels, by_irradiance = torch.empty(work.texels, 3), torch.empty(chunks, *irradiance.shape)
        buffers = {
            "halo": torch.empty(chunks * library.refgs_shade_halo_size(work.width, work.channels)),
            "by_chunk_texels": torch.empty(chunks, work.texels, 4),
        }
        work.attach(**given, **buffers, by_features=by_features, by_alpha=by_alpha)
        work.attach(by_levels=by_levels, by_irradiance=by_irradiance)
        parallel(library.refgs_shade_backward, work)
        parallel(library.refgs_shade_gather, work)
        return by_features, by_alpha, by_levels, by_irradiance.sum(dim=0), None, None, None, None


def mirror_directions(features: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Where `shade` looks for light (H, W, 3): the ways to the camera, mirrored at the blended normals; unit vectors in
    world space, zero where nothing is. `features` and `alpha` as `shade` takes them beside a visibility; without gradients."""
    if features.shape not in ((*alpha.shape, CHANNELS + 3), (*alpha.shape, CHANNELS + 6)):
        raise ValueError(f"expected {CHANNELS + 3} or {CHANNELS + 6} features a pixel, got {tuple(features.shape)}")
    features, alpha = features.detach().contiguous(), alpha.detach().contiguous()
    work, mirrored = _Work.of(features, alpha, camera), torch.empty(*alpha.shape, 3)
    work.attach(mirrored=mirrored)
    parallel(kernels().refgs_shade_mirrored, work)
    return mirrored


def shade(
    features: Tensor,
    alpha: Tensor,
    environment: Environment,
    camera: Camera,
    background: Tensor,
    visibility: Tensor | None = None,
) -> Shaded:
    """Shade what the rasteriser blended by the split sum (paper Eq. 5–10), over a background (3,), sRGB-encoded.

    `features` (H, W, C) are sums over a pixel's splats of, in this order: normal in world space, albedo, metallic,
    roughness; three of colour by direction, where that takes the place of integrated diffuse light (the paper's
    substitute); three of radiance from the object itself, where there is a `visibility` (H, W) in 0..1, by which that
    gives way to the environment's (Eq. 9); position. `alpha` (H, W). float32 on the CPU, differentiable in features,
    alpha and the light. What the blend's mean position says of its bias towards the camera is undone first: shade.cpp
    has how. The result does not depend on the number of threads.
    """
    least = CHANNELS + 3 * (visibility is not None)
    if features.shape not in ((*alpha.shape, least), (*alpha.shape, least + 3)):
        size = f"{alpha.shape[1]}×{alpha.shape[0]}"
        raise ValueError(f"expected {least} or {least + 3} features a pixel of {size}, got {tuple(features.shape)}")
    light = environment.levels, environment.irradiance, environment.sides
    return Shaded(*_Shade.apply(features, alpha, *light, camera, background, visibility))
