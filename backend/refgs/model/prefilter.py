"""GGX prefiltering of a cubemap: the second factor of the split sum (paper Eq. 8) at a few fixed roughnesses.

With N = V = R (Karis, "Real Shading in Unreal Engine 4", 2013) the filtered radiance is Σ L(l) K(θ) / Σ K(θ),
K(θ) = D(cos θ/2) cos θ, θ the angle between l and the lobe's axis. K depends on θ and roughness alone, so each level is
one fixed sparse matrix over the texels of the cubemap and of its pooled mips: fine texels at the lobe's core,
coarse ones in its tail.
"""

import ctypes
import hashlib
import os
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import platformdirs
import torch
from scipy import integrate, sparse
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.kernels.load import Shared, Work, check, run
from refgs.model import cubemap

ROUGHNESS = (0.0, 0.18, 0.35, 0.6, 1.0)  # of the levels; level 0 is the cubemap itself
DIVISOR = (1, 2, 4, 8, 8)  # a level's side is the cubemap's divided by this
CELLS = (0, 64, 128, 256, 256)  # a texel of the pyramid is split while it holds more than 1/CELLS of the lobe
COARSEST = 4  # side of the last pooled mip
SAMPLES = 3  # sub-samples of the lobe along each side of a texel


def level_sides(resolution: int) -> list[int]:
    """Side of each prefiltered level, in texels."""
    return [max(resolution // d, COARSEST) for d in DIVISOR]


def _pyramid_sides(resolution: int) -> list[int]:
    sides = [resolution]
    while sides[-1] > COARSEST:
        sides.append(sides[-1] // 2)
    return sides


def ggx_lobe(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """K(θ) up to a factor, for cos θ; zero below the horizon."""
    a2 = roughness**4  # α² with α = roughness²
    half = (1 + cosine) / 2  # cos²(θ/2)
    return np.maximum(cosine, 0) / (half * (a2 - 1) + 1) ** 2


def _level_matrix(
    resolution: int, side: int, roughness: float, cells: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One level's rows as (row, pyramid texel, weight), rows summing to one."""
    axes = cubemap.texel_directions(side).numpy()
    sides = _pyramid_sides(resolution)
    offsets = np.concatenate([[0], np.cumsum([6 * s * s for s in sides])])
    cosine = 1 - np.linspace(0, 1, 100_001) ** 4  # dense where a narrow lobe is
    whole = -2 * np.pi * integrate.trapezoid(ggx_lobe(cosine, roughness), cosine)
    rows, columns, weights = [], [], []
    row = np.repeat(np.arange(len(axes)), 6 * COARSEST**2)
    texel = np.tile(np.arange(6 * COARSEST**2), len(axes))
    for mip in reversed(range(len(sides))):
        n = sides[mip]
        area = cubemap.texel_solid_angles(n).numpy()[texel]
        share = _lobe_over_texels(axes[row], texel, n, roughness) * area / whole
        seen = share > 1e-5
        row, texel, share = row[seen], texel[seen], share[seen]
        keep = share < 1 / cells if mip else np.ones(len(share), dtype=bool)
        rows.append(row[keep])
        columns.append(texel[keep] + offsets[mip])
        weights.append(share[keep])
        split = texel[~keep]
        face, r, c = split // (n * n), split // n % n, split % n
        children = [(face * 2 * n + 2 * r + i) * 2 * n + 2 * c + j for i in (0, 1) for j in (0, 1)]
        row, texel = np.tile(row[~keep], 4), np.concatenate(children)
    rows, columns, weights = np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)
    return rows, columns, weights / np.bincount(rows, weights, len(axes))[rows]


def _lobe_over_texels(axes: np.ndarray, texel: np.ndarray, side: int, roughness: float) -> np.ndarray:
    """The lobe about each axis, averaged over its texel: it changes within one."""
    fine = cubemap.texel_directions(side * SAMPLES).numpy().reshape(6, side, SAMPLES, side, SAMPLES, 3)
    face, row, column = texel // (side * side), texel // side % side, texel % side
    value = np.zeros(len(texel))
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            value += ggx_lobe(np.einsum("ij,ij->i", axes, fine[face, row, i, column, j]), roughness)
    return value / SAMPLES**2


def _cache_file(resolution: int) -> Path:
    # The source is part of the key: a change of the lobe or of a constant must not read an older file.
    source = Path(__file__).read_bytes() + Path(cubemap.__file__).read_bytes()
    key = hashlib.sha256(source).hexdigest()[:16]
    return Path(platformdirs.user_cache_dir("refgs")) / f"prefilter-{resolution}-{key}.npz"


class Matrix(NamedTuple):
    """A sparse matrix by rows: where each row's numbers start (rows + 1), int32; the numbers' columns, int32; float32."""

    starts: Tensor
    columns: Tensor
    numbers: Tensor

    @classmethod
    def of(cls, matrix: sparse.csr_matrix, device: torch.device) -> "Matrix":
        parts = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data.astype(np.float32)
        return cls(*(torch.from_numpy(part).to(device) for part in parts))


@lru_cache(maxsize=4)
def matrices(resolution: int, device: torch.device) -> tuple[Matrix, Matrix]:
    """The levels above 0 stacked, as a matrix over the pyramid's texels, and its transpose."""
    file = _cache_file(resolution)
    if file.exists():
        matrix = sparse.load_npz(file)
    else:
        parts, offset = [], 0
        for side, roughness, cells in zip(level_sides(resolution)[1:], ROUGHNESS[1:], CELLS[1:], strict=True):
            row, column, weight = _level_matrix(resolution, side, roughness, cells)
            parts.append((row + offset, column, weight))
            offset += 6 * side * side
        row, column, weight = (np.concatenate(p) for p in zip(*parts, strict=True))
        width = sum(6 * s * s for s in _pyramid_sides(resolution))
        matrix = sparse.csr_matrix((weight.astype(np.float32), (row, column)), shape=(offset, width))
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}.npz")
        sparse.save_npz(temporary, matrix, compressed=False)
        os.replace(temporary, file)
    return Matrix.of(matrix, device), Matrix.of(matrix.T.tocsr(), device)


@lru_cache(maxsize=4)
def _pyramid(resolution: int, device: torch.device) -> tuple[Matrix, Matrix]:
    """The cubemap and its pooled mips, means by solid angle, as a matrix over the cubemap's texels; and its transpose."""
    mip = sparse.identity(6 * resolution**2, format="csr")
    mips = [mip]
    for side in _pyramid_sides(resolution)[:-1]:
        area = cubemap.texel_solid_angles(side).reshape(6, side // 2, 2, side // 2, 2)
        share = (area / area.sum(dim=(2, 4), keepdim=True)).reshape(-1).numpy()
        texel = np.arange(6 * side * side)
        face, row, column = texel // (side * side), texel // side % side, texel % side
        parent = (face * (side // 2) + row // 2) * (side // 2) + column // 2
        mip = sparse.csr_matrix((share, (parent, texel)), shape=(len(texel) // 4, len(texel))) @ mip
        mips.append(mip)
    matrix = sparse.vstack(mips, format="csr")
    return Matrix.of(matrix, device), Matrix.of(matrix.T.tocsr(), device)


class _Work(Work):
    """`struct Product` of sparse.cpp."""

    _fields_ = (
        ("rows", ctypes.c_int64),
        *((n, ctypes.c_void_p) for n in ("starts", "columns", "numbers", "dense", "out", "scratch")),
        ("shared", Shared),
    )


def _product(matrix: Matrix, dense: Tensor, out: Tensor) -> Tensor:
    """Into `out`; of `dense`, a float more than its numbers is read."""
    work = _Work(rows=len(matrix.starts) - 1)
    work.attach(**matrix._asdict(), dense=dense, out=out)
    run("refgs_sparse_product", work, out, items=32 * work.rows)
    return out


class _Prefilter(torch.autograd.Function):
    @staticmethod
    def forward(ctx, radiance: Tensor, resolution: int) -> Tensor:
        ctx.resolution = resolution
        pool, lobes = _pyramid(resolution, radiance.device)[0], matrices(resolution, radiance.device)[0]
        pyramid = radiance.new_empty(len(pool.starts), 3)  # a row more than there are, to be read from
        _product(pool, torch.nn.functional.pad(radiance, (0, 0, 0, 1)), pyramid)
        levels = radiance.new_empty(len(radiance) + len(lobes.starts) - 1, 3)
        levels[: len(radiance)] = radiance
        _product(lobes, pyramid, levels[len(radiance) :])
        return levels

    @staticmethod
    @once_differentiable
    def backward(ctx, by_levels: Tensor):
        pool, lobes = _pyramid(ctx.resolution, by_levels.device)[1], matrices(ctx.resolution, by_levels.device)[1]
        count = 6 * ctx.resolution**2
        by_pyramid = by_levels.new_empty(len(lobes.starts), 3)
        _product(lobes, torch.nn.functional.pad(by_levels[count:], (0, 0, 0, 1)), by_pyramid)
        by_radiance = _product(pool, by_pyramid, by_levels.new_empty(count, 3))
        return by_radiance.add_(by_levels[:count]), None


def prefilter(radiance: Tensor, resolution: int) -> Tensor:
    """All levels of a cubemap (6·R², 3) one after another, (Σ 6·side², 3): linear radiance in, linear radiance out."""
    check(radiance=(radiance, (6 * resolution**2, 3)))
    return _Prefilter.apply(radiance, resolution)
