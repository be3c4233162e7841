"""Blend splats at points on a surface, as if a camera looked straight at each point."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from torch import Tensor

from refgs.formats.splats import Splats
from refgs.model.surfels import axes

NEAREST = 64  # splats tested per ray
LEAST_ALPHA = 1 / 255  # alpha at or below which a splat is transparent
REACH = 3.0  # largest distance of a splat from the surface, in its standard deviations
RIDGE = 0.1  # part of the positions' total variance: bounds the normals' slope where splats lie in a line
NORMAL = slice(5, 8)  # its columns in the result of `composite`
_CHUNK = 1 << 13  # points at a time: about 100 MB

Progress = Callable[[int, int], None]


def composite(splats: Splats, points: np.ndarray, normals: np.ndarray, progress: Progress) -> np.ndarray:
    """Composite the splats at points (N, 3) on a surface with unit normals (N, 3).

    Returns (N, 8): base colour, metallic, roughness, unit normal. If `splats.doubt` is given, it is composited into a ninth column.

    At each point a ray looks at the surface from outside, along the reversed normal. Splats are composited front to back if they are near
    the surface and face outwards. A splat's alpha is its opacity times its Gaussian where the ray meets the splat's plane. The result is
    divided by the sum of the weights. If no splat meets the ray, the nearest splats give the values.

    The blended normal is right at the mean position of the splats, not at the point. So a slope, the change of the normal with position, is
    fitted to the splats by weighted least squares. The slope times the distance corrects the blended normal. `progress` is called with the
    number of points done and their total.
    """
    table, values = _geometry(splats), _appearance(splats)
    spread = float(np.median(splats.scales[:, :2].mean(axis=1))) or 1.0
    count = min(NEAREST, len(splats))
    # Points in one cell, half a splat wide, share their neighbours.
    cell = np.floor(points / (spread / 2)).astype(np.int64)
    cell -= cell.min(axis=0)
    _, first, cell = np.unique(np.ravel_multi_index(cell.T, cell.max(0) + 1), return_index=True, return_inverse=True)
    tree, near = cKDTree(splats.positions), np.empty((len(first), count), np.int32)
    # Query in chunks: float64 distances and int64 indices take four times the memory of `near`.
    for start in range(0, len(first), _CHUNK):
        at = slice(start, start + _CHUNK)
        near[at] = tree.query(points[first[at]], k=np.arange(1, count + 1), workers=-1)[1]
    result = np.empty((len(points), values.shape[1]), np.float32)
    with torch.no_grad():
        for start in range(0, len(points), _CHUNK):
            at = slice(start, start + _CHUNK)
            place, normal = (torch.from_numpy(np.asarray(x[at], np.float32)) for x in (points, normals))
            result[at] = _blend(table, values, torch.from_numpy(near[cell[at]]), place, normal, spread).numpy()
            progress(min(start + _CHUNK, len(points)), len(points))
    return result


def blended_normals(splats: Splats) -> np.ndarray:
    """Compute the unit normal (N, 3) of the surface at each splat: `composite` at the splats' positions.

    The learned normals of splats that share a pixel differ by 16° to 24°, though their blend is right to a degree or two. Programs that
    shade each splat by itself, as Blender does, need the blend. If the blend points to the back of the splat's plane, the splat's own
    normal is returned instead.
    """
    own = _outward(splats)
    blended = composite(splats, splats.positions, own, lambda done, total: None)[:, NORMAL]
    return np.where((blended * own).sum(axis=1, keepdims=True) > 0, blended, own)


def _outward(splats: Splats) -> np.ndarray:
    """Return the unit normals (N, 3) of the splats' planes, towards the side of `splats.normals`."""
    plane = axes(torch.from_numpy(splats.rotations))[2].numpy()
    return np.where((plane * splats.normals).sum(axis=1, keepdims=True) < 0, -plane, plane)


def _geometry(splats: Splats) -> Tensor:
    """Collect the splats' positions, scaled axes, normals, opacities and sizes in a table (N, 17)."""
    # Columns: position, two axes over their standard deviations, the plane's normal, the outward normal, opacity, mean standard deviation.
    u, v, normal = (axis.numpy() for axis in axes(torch.from_numpy(splats.rotations)))
    scales = np.maximum(splats.scales[:, :2], 1e-12)
    columns = [splats.positions, u / scales[:, :1], v / scales[:, 1:], normal, _outward(splats)]
    columns += [splats.opacities[:, None], scales.mean(axis=1, keepdims=True)]
    return torch.from_numpy(np.concatenate(columns, axis=1).astype(np.float32))


def _appearance(splats: Splats) -> Tensor:
    columns = [splats.albedo, splats.metallic[:, None], splats.roughness[:, None], _outward(splats)]
    if splats.doubt is not None:
        columns.append(splats.doubt[:, None])
    return torch.from_numpy(np.concatenate(columns, axis=1).astype(np.float32))


def _blend(table: Tensor, values: Tensor, near: Tensor, points: Tensor, normals: Tensor, spread: float) -> Tensor:
    rows = table[near.flatten()].view(*near.shape, -1)
    center, u, v, plane, outward, opacity, deviation = rows.split((3, 3, 3, 3, 3, 1, 1), dim=-1)
    offset, ray = center - points[:, None], normals[:, None]

    slant = (plane * ray).sum(dim=-1)
    slant = torch.where(slant.abs() < 1e-3, 1e-3, slant)
    height = (plane * offset).sum(dim=-1) / slant  # of the ray's intersection with the splat, above the surface
    met = height[..., None] * ray - offset
    apart = (u * met).sum(dim=-1) ** 2 + (v * met).sum(dim=-1) ** 2
    alpha = opacity[..., 0] * torch.exp(-0.5 * apart)
    contributes = (alpha > LEAST_ALPHA) & ((outward * ray).sum(dim=-1) > 0) & (height.abs() < REACH * deviation[..., 0])
    alpha = torch.where(contributes, alpha, 0)
    order = height.argsort(dim=1, descending=True)
    passed = (1 - alpha.gather(1, order)).cumprod(dim=1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    weight = alpha * torch.empty_like(alpha).scatter_(1, order, before)
    covered = weight.sum(dim=1, keepdim=True)
    # Add tiny weights by distance, which decide where no splat reaches.
    weight = weight + 1e-5 / (1 + (offset * offset).sum(dim=-1) / spread**2) ** 4
    weight = (weight / weight.sum(dim=1, keepdim=True))[:, None]

    of_splats = values[near.flatten()].view(*near.shape, -1)
    blended = (weight @ of_splats)[:, 0]
    mean = weight @ offset  # (n, 1, 3)
    across = (offset - mean) * weight.transpose(1, 2)
    square = across.transpose(1, 2) @ (offset - mean)
    square = square + (RIDGE * square.diagonal(dim1=1, dim2=2).sum(dim=1) + 1e-12)[:, None, None] * torch.eye(3)
    slope = torch.linalg.solve(square, across.transpose(1, 2) @ (of_splats[..., NORMAL] - blended[:, None, NORMAL]))
    along = mean[:, 0] - (mean[:, 0] * normals).sum(dim=1, keepdim=True) * normals
    blended[:, NORMAL] -= covered * (along[:, None] @ slope)[:, 0]
    blended[:, NORMAL] = torch.nn.functional.normalize(blended[:, NORMAL], dim=1)
    return blended
