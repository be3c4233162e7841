"""Prefilter a cubemap with the GGX lobe at a few fixed roughnesses, for specular reflection.

The result is the second factor of the split sum (Ref-Gaussian paper, Eq. 8). As in Karis ("Real Shading in Unreal Engine 4", 2013),
normal, view and reflection direction are assumed to be equal. The filtered radiance in a direction is then Σ L(l) K(θ) / Σ K(θ) with K(θ) =
D(cos(θ/2)) cos θ. D is the GGX distribution, and θ is the angle between that direction and l. K depends only on θ and on the roughness, so
each filtered level is a constant sparse matrix times the cubemap.

To keep the matrices small, they read a pyramid: the cubemap, followed by its mips, which are averaged 2×2. Fine texels cover the centre of
the lobe, coarse texels its tail. The matrices have the cube's symmetries, so only a 24th of their entries is computed and stored. They
are not cached on disk, because computing them takes only 0.05 s for 6×64² texels and 0.25 s for 6×128².
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from scipy import integrate, sparse
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.clock import timed
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run
from refgs.model import cubemap
from refgs.model.cubemap import SYMMETRIES

ROUGHNESS = (0.0, 0.08, 0.15, 0.25, 0.4, 0.65, 1.0)  # of the levels; level 0 is the cubemap itself
DIVISOR = (1, 2, 2, 4, 4, 8, 8)  # a level's side is the cubemap's divided by this
CELLS = 256  # a pooled texel is split while it holds more than 1/CELLS of the lobe
LEAST_SHARE = 1e-5  # of the lobe; texels that hold less are skipped
LEAST_SIDE = 8  # of a level, unless the cubemap is coarser
IRRADIANCE_SIDE = 16  # of the last level; it resolves the terminator of a sun's light
COARSEST = 4  # side of the last pooled mip
SAMPLES = 3  # sub-samples of the lobe along each side of a texel


def level_sides(resolution: int) -> list[int]:
    """Return each prefiltered level's side in texels; the last level holds irradiance."""
    sides = [max(resolution // d, min(resolution, LEAST_SIDE)) for d in DIVISOR]
    return [*sides, min(resolution, IRRADIANCE_SIDE)]


def level_of(roughness):
    """Return the index of the prefiltered level for a roughness, which is a number or a float array.

    Between two of `ROUGHNESS`, the index is fractional: it is interpolated linearly in roughness squared.
    """
    return np.interp(np.square(roughness), np.square(ROUGHNESS), np.arange(len(ROUGHNESS)))


def _pyramid_sides(resolution: int) -> list[int]:
    sides = [resolution]
    while sides[-1] > COARSEST:
        sides.append(sides[-1] // 2)
    return sides


def ggx_lobe(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Evaluate the GGX lobe D(cos(θ/2)) cos θ, up to a constant factor, from cos θ."""
    a2 = roughness**4  # α² with α = roughness²
    half = (1 + cosine) / 2  # cos²(θ/2)
    return np.maximum(cosine, 0) / (half * (a2 - 1) + 1) ** 2


def cosine_lobe(cosine: np.ndarray) -> np.ndarray:
    """Evaluate the cosine lobe max(0, cos θ), by which irradiance weights radiance."""
    return np.maximum(cosine, 0)


Lobe = Callable[[np.ndarray], np.ndarray]
LOBES = (*(partial(ggx_lobe, roughness=roughness) for roughness in ROUGHNESS[1:]), cosine_lobe)  # of levels 1 and up


def _level_weights(resolution: int, side: int, lobe: Lobe, coarsest: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the filter weights of one level: how much each texel of the pyramid adds to each texel of the level.

    The pyramid is the cubemap and its mips. Mips with fewer than `coarsest` texels a side are not read. `side` is the side of the level in
    texels, and `lobe` is the filter as a function of the cosine.

    Returns three arrays with an entry for each weight: the index of the pyramid's texel, the index of the level's texel in orbit order
    (`cubemap.orbit_order`), and the weight. Only the pyramid's texels in one quarter of face +x are listed and counted: the second half of
    its rows and columns. The weights of all other texels follow from the cube's symmetries. All weights of a texel of the level sum to one.
    """
    axes = cubemap.texel_directions(side)[cubemap.orbits(side).flatten()].numpy()
    sides = _pyramid_sides(resolution)
    starts = np.cumsum([0] + [n * n // 4 for n in sides])
    cosine = 1 - np.linspace(0, 1, 100_001) ** 4  # dense where a narrow lobe is
    whole = -2 * np.pi * integrate.trapezoid(lobe(cosine), cosine)
    parts = []
    axis, row, column = np.indices((len(axes), coarsest // 2, coarsest // 2)).reshape(3, -1)
    for n, start in zip(reversed(sides), reversed(starts[:-1]), strict=True):
        if n < coarsest:
            continue
        half = n // 2
        area = cubemap.texel_solid_angles(n).numpy().reshape(6, n, n)[0, half:, half:]
        share = _lobe_over_texels(axes[axis], row, column, n, lobe) * area[row, column] / whole
        split = (share > 1 / CELLS) & (n < resolution)
        kept = (share > LEAST_SHARE) & ~split
        parts.append((start + row[kept] * half + column[kept], axis[kept], share[kept]))
        axis = np.repeat(axis[split], 4)
        row, column = (np.add.outer(2 * a[split], b).ravel() for a, b in ((row, (0, 0, 1, 1)), (column, (0, 1, 0, 1))))
    orbit, axis, weight = (np.concatenate(p) for p in zip(*parts, strict=True))
    return orbit, axis, weight / np.bincount(axis // SYMMETRIES, weight)[axis // SYMMETRIES]


def _lobe_over_texels(axes: np.ndarray, row: np.ndarray, column: np.ndarray, side: int, lobe: Lobe) -> np.ndarray:
    """Average a lobe over the area of each of P texels. Returns (P,).

    `axes` (P, 3) are unit directions: for each texel, the one in which the lobe points. The texels lie on face +x of a cubemap with `side`
    texels a side. `row` and `column` (P,) are their indices, counted from the face's middle: 0 is the first texel after it.
    """
    value = np.zeros(len(axes))
    x, y, z = np.ascontiguousarray(axes.T)
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            s, t = (2 / side * (place + (k + 0.5) / SAMPLES) for place, k in ((column, j), (row, i)))
            value += lobe((x + y * s + z * t) / np.sqrt(1 + s * s + t * t))
    return value / SAMPLES**2


class Matrix(NamedTuple):
    """Store a sparse matrix that does not change under the 24 symmetries of the cube. It maps texels to texels.

    Rows and columns stand for texels in orbit order (`cubemap.orbit_order`): groups of 24 that the symmetries map onto each other. A
    symmetry that maps texel a to a' and texel b to b' leaves the matrix unchanged: element (a', b') equals element (a, b). So the first row
    of each group determines the other 23 rows, and only the first is stored.
    """

    starts: Tensor  # (orbits + 1), int32: the start of each row's numbers
    columns: Tensor  # int32, of the numbers; images by the same symmetry are adjacent
    numbers: Tensor  # float32
    compositions: Tensor  # int32, cubemap.compositions()

    @classmethod
    def of(
        cls, orbits: int, orbit: np.ndarray, column: np.ndarray, number: np.ndarray, device: torch.device
    ) -> "Matrix":
        by_symmetry = SYMMETRIES * orbit + column % SYMMETRIES
        shape = SYMMETRIES * orbits, column.max() + 1
        matrix = sparse.csr_matrix((number.astype(np.float32), (by_symmetry, column)), shape)
        indices = matrix.indptr[::SYMMETRIES], matrix.indices, cubemap.compositions().numpy()
        starts, columns, compositions = (torch.from_numpy(part.astype(np.int32)).to(device) for part in indices)
        return cls(starts, columns, torch.from_numpy(matrix.data).to(device), compositions)


def _matrix_and_transpose(
    shape: tuple[int, int], orbit: np.ndarray, column: np.ndarray, number: np.ndarray, device: torch.device
) -> tuple[Matrix, Matrix]:
    """Make a `Matrix` and its transpose from the first row of each group of 24 rows. The other rows follow from it (see `Matrix`).

    `orbit`, `column` and `number` list the nonzero elements of these rows: the index of the group, the column, and the value. `shape` is
    the number of groups of 24 rows and the number of groups of 24 columns.
    """
    # A number at row 24 i, column 24 j + h is also at row 24 i + g, column 24 j, where g is the inverse of h.
    inverse = (cubemap.compositions() == 0).int().argmax(dim=1).numpy()
    transpose = column // SYMMETRIES, SYMMETRIES * orbit + inverse[column % SYMMETRIES], number
    return Matrix.of(shape[0], orbit, column, number, device), Matrix.of(shape[1], *transpose, device)


@lru_cache(maxsize=4)
def matrices(resolution: int, device: torch.device) -> tuple[Matrix, Matrix]:
    """Return the sparse matrix from the pyramid to all prefiltered levels, and its transpose."""
    itself = np.arange(resolution**2 // 4)  # level 0
    parts, start = [(itself, SYMMETRIES * itself, np.ones(len(itself)))], 6 * resolution**2
    for side, lobe in zip(level_sides(resolution)[1:], LOBES, strict=True):
        # The cosine falls linearly to the horizon: coarse texels there would misplace the terminator of a sun's light.
        coarsest = side if lobe is cosine_lobe else COARSEST
        orbit, texel, weight = _level_weights(resolution, side, lobe, coarsest)
        parts.append((orbit, start + texel, weight))
        start += 6 * side * side
    shape = sum(n * n // 4 for n in _pyramid_sides(resolution)), start // SYMMETRIES
    orbit, texel, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    transpose, matrix = _matrix_and_transpose(shape, orbit, texel, weight, device)
    return matrix, transpose


@lru_cache(maxsize=4)
def _of_irradiance(resolution: int, device: torch.device) -> Matrix:
    """Return the transpose of the sparse matrix from the pyramid to irradiance, the last level."""
    side = level_sides(resolution)[-1]
    shape = sum(n * n // 4 for n in _pyramid_sides(resolution)), side * side // 4
    weights = _level_weights(resolution, side, cosine_lobe, coarsest=side)
    transpose, _ = _matrix_and_transpose(shape, *weights, device)
    return transpose


@lru_cache(maxsize=4)
def _pyramid(resolution: int, device: torch.device) -> tuple[Matrix, Matrix]:
    """Return the sparse matrix from a cubemap to its pyramid of mips, and its transpose."""
    mip = sparse.identity(resolution**2 // 4, format="csr")
    mips = [mip]
    for side in _pyramid_sides(resolution)[:-1]:
        half, quarter = side // 2, side // 4
        area = cubemap.texel_solid_angles(side)[cubemap.orbits(side)[:, 0]].reshape(quarter, 2, quarter, 2)
        share = (area / area.sum(dim=(1, 3), keepdim=True)).flatten().numpy()
        texel = np.arange(half * half)
        parent = texel // half // 2 * quarter + texel % half // 2
        mip = sparse.csr_matrix((share, (parent, texel))) @ mip
        mips.append(mip)
    matrix = sparse.coo_matrix(sparse.vstack(mips))
    shape = sum(side * side // 4 for side in _pyramid_sides(resolution)), resolution**2 // 4
    return _matrix_and_transpose(shape, matrix.row, SYMMETRIES * matrix.col, matrix.data, device)


@lru_cache(maxsize=4)
def _order(resolution: int, device: torch.device) -> Tensor:
    return cubemap.orbit_order((resolution,)).int().to(device)


_Work = struct("Product", "sparse.cpp")


def _product(matrix: Matrix, dense: Tensor, rows: Tensor | None = None) -> Tensor:
    """Multiply a `Matrix` by RGB in orbit order; with `rows`, store row i at `rows[i]`."""
    work = _Work(orbits=len(matrix.starts) - 1)
    out = dense.new_empty(SYMMETRIES * work.orbits, 3)
    work.attach(**matrix._asdict(), dense=dense, out=out, **({} if rows is None else {"rows": rows}))
    run("refgs_sparse_product", work, out, items=32 * SYMMETRIES * work.orbits)
    return out


@timed("prefilter")
class _Prefilter(Function):
    @staticmethod
    def forward(ctx, radiance: Tensor, resolution: int, taught: Tensor | None) -> Tensor:
        ctx.resolution, ctx.taught, device = resolution, taught, radiance.device
        ordered = radiance.index_select(0, _order(resolution, device))
        pyramid = _product(_pyramid(resolution, device)[0], ordered)
        return _product(matrices(resolution, device)[0], pyramid)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_levels: Tensor):
        resolution, device = ctx.resolution, by_levels.device
        by_levels, pyramid, order = by_levels.contiguous(), _pyramid(resolution, device)[1], _order(resolution, device)
        by_radiance = _product(pyramid, _product(matrices(resolution, device)[1], by_levels), rows=order)
        if ctx.taught is not None:
            last = by_levels[-6 * level_sides(resolution)[-1] ** 2 :]
            by_irradiance = _product(pyramid, _product(_of_irradiance(resolution, device), last), rows=order)
            by_radiance -= by_irradiance * ~ctx.taught[:, None]
        return by_radiance, None, None


def prefilter(radiance: Tensor, resolution: int, taught: Tensor | None = None) -> Tensor:
    """Prefilter a cubemap (6·R², 3) of linear radiance for each of `ROUGHNESS`.

    Returns the levels stacked, (Σ 6·side², 3); `level_sides` gives their sides. The last level is irradiance / π. The texels of each level
    are in orbit order; `cubemap.in_texel_order` reorders them by face, row, column.

    The mask `taught` (6·R²,) selects the texels that get a gradient from irradiance. Without it, all do.
    """
    check(radiance=(radiance, (6 * resolution**2, 3)))
    return _Prefilter.apply(radiance, resolution, taught)


def irradiance(levels: Tensor, sides: tuple[int, ...], normals: Tensor) -> Tensor:
    """Look up irradiance / π (P, 3) in `prefilter`'s levels, differentiably and on the CPU."""
    last = cubemap.in_texel_order(levels, sides)[-6 * sides[-1] ** 2 :]
    return cubemap.sample(last, sides[-1:], normals, torch.zeros(len(normals), dtype=normals.dtype))
