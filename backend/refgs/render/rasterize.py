"""Surfels to maps: the differentiable rasteriser."""

import ctypes
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.kernels.load import Shared, Work, borrow, check, kernels, parallel


class Raster(NamedTuple):
    """Sums over the splats of a pixel, front to back, with weights w = α Π (1 − α of those in front) (paper Eq. 5).

    Premultiplied, without a background; divide by `alpha` for means. `depth` is along the camera's axis, at the ray–splat
    intersection (paper Eq. 4), or the splat's centre where the screen-space filter draws it.
    """

    features: Tensor
    depth: Tensor
    alpha: Tensor


class _Work(Work):
    """`struct Raster` of raster.h."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("splats", "channels", "width", "height")]
        + [(n, ctypes.c_void_p) for n in ("positions", "rotations", "scales", "opacities", "features")]
        + [("view", ctypes.c_double * 12)]
        + [(n, ctypes.c_double) for n in ("fx", "fy", "cx", "cy", "near")]
        + [(n, ctypes.c_void_p) for n in ("projected", "octagons", "keys", "order")]
        + [(n, ctypes.c_int64) for n in ("visible", "pairs")]
        + [(n, ctypes.c_void_p) for n in ("splat_start", "tile_start", "members", "places")]
        + [(n, ctypes.c_void_p) for n in ("out_features", "out_depth", "out_alpha", "reach")]
        + [(n, ctypes.c_void_p) for n in ("by_features", "by_depth", "by_alpha", "row_start")]
        + [("row_count", ctypes.c_int64), ("rows", ctypes.c_void_p)]
        + [(n, ctypes.c_void_p) for n in ("by_positions", "by_rotations", "by_scales", "by_opacities")]
        + [("by_splat_features", ctypes.c_void_p), ("scratch", ctypes.c_void_p), ("shared", Shared)]
    )


def _project_and_bin(work: _Work, camera: Camera, near: float) -> dict[str, Tensor]:
    """Fill the work's geometry: what it points at is returned."""
    library, n = kernels(), work.splats
    work.width, work.height = camera.width, camera.height
    work.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
    work.fx, work.fy, work.cx, work.cy, work.near = camera.fx, camera.fy, camera.cx, camera.cy, near
    tiles = library.refgs_tiles(camera.width, camera.height)
    bins = {
        "projected": torch.empty(n * library.refgs_projected_size(), dtype=torch.uint8),
        "octagons": torch.empty(n * library.refgs_octagon_size(), dtype=torch.uint8),
        "order": torch.empty(n, dtype=torch.int32),
        "splat_start": torch.empty(n + 1, dtype=torch.int64),
        "tile_start": torch.empty(tiles + 1, dtype=torch.int64),
        "reach": torch.empty(tiles, dtype=torch.int32),
    }
    work.attach(**bins, keys=borrow("keys", 4 * n))
    parallel(library.refgs_project, work)
    library.refgs_sort(ctypes.byref(work))
    bins |= {
        "members": torch.empty(work.pairs, dtype=torch.int32),
        "places": torch.empty(work.pairs, dtype=torch.int32),
    }
    work.attach(members=bins["members"], places=bins["places"])
    library.refgs_bin(ctypes.byref(work))
    return bins


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, positions, rotations, scales, opacities, features, camera, near):
        inputs = {
            "positions": positions.contiguous(),
            "rotations": rotations.contiguous(),
            "scales": scales.contiguous(),
            "opacities": opacities.contiguous(),
            "features": features.contiguous(),
        }
        work = _Work(splats=features.shape[0], channels=features.shape[1])
        work.attach(**inputs)
        bins = _project_and_bin(work, camera, near)
        outputs = {
            "out_features": torch.empty(camera.height, camera.width, features.shape[1]),
            "out_depth": torch.empty(camera.height, camera.width),
            "out_alpha": torch.empty(camera.height, camera.width),
        }
        work.attach(**outputs)
        library = kernels()
        parallel(library.refgs_forward, work, library.refgs_scratch_size(work.channels))
        ctx.save_for_backward(*inputs.values(), *outputs.values())
        ctx.work, ctx.bins = work, bins
        return tuple(outputs.values())

    @staticmethod
    @once_differentiable
    def backward(ctx, by_features, by_depth, by_alpha):
        library, work = kernels(), ctx.work
        saved = ctx.saved_tensors  # also checks that nobody changed them
        row_start = torch.empty_like(ctx.bins["tile_start"])
        work.attach(row_start=row_start)
        library.refgs_rows(ctypes.byref(work))
        buffers = {
            "by_features": by_features.contiguous(),
            "by_depth": by_depth.contiguous(),
            "by_alpha": by_alpha.contiguous(),
            "rows": borrow("rows", work.row_count * library.refgs_row_size(work.channels)),
        }
        gradients = {
            "by_positions": torch.empty_like(saved[0]),
            "by_rotations": torch.empty_like(saved[1]),
            "by_scales": torch.empty_like(saved[2]),
            "by_opacities": torch.empty_like(saved[3]),
            "by_splat_features": torch.empty_like(saved[4]),
        }
        work.attach(**buffers, **gradients)
        parallel(library.refgs_backward, work, library.refgs_scratch_size(work.channels))
        parallel(library.refgs_gather, work)
        return *gradients.values(), None, None


def rasterize(
    positions: Tensor,
    rotations: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    near: float,
) -> Raster:
    """Blend surfels front to back (by their centres' depths) into maps of any number of features.

    `positions` (N, 3) in the world, `rotations` (N, 4) quaternions wxyz of any length, `scales` (N, 2) standard deviations
    along the surfel's axes in world units, `opacities` (N,) in [0, 1], `features` (N, C); float32 on the CPU, differentiable
    in all five. Surfels whose centres are nearer than `near` (> 0, world units) are not drawn; of the others, what the rays
    meet nearer than that is not. Returns maps (H, W, C), (H, W), (H, W).

    The constants of the blending (alpha below 1/255 is nothing, alpha is at most 0.99, a pixel is finished at
    transmittance 1e-4, screen-space filter of σ = √2/2 pixels as in 2DGS) are in kernels/splat.h. The result does not depend
    on the number of threads.
    """
    n, channels = features.shape[0], features.shape[1:2]
    check(positions=(positions, (n, 3)), rotations=(rotations, (n, 4)), scales=(scales, (n, 2)))
    check(opacities=(opacities, (n,)), features=(features, (n, *channels)))
    if max(camera.width, camera.height) > 16383:
        raise ValueError(f"images are at most 16,383 pixels wide and high, not {camera.width}×{camera.height}")
    if near <= 0:
        raise ValueError(f"near must be positive, got {near}")
    return Raster(*_Rasterize.apply(positions, rotations, scales, opacities, features, camera, near))
