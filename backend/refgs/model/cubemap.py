"""Look up values in cubemaps that are stored as flat lists of texels.

A cubemap with R×R texels a face is a list of 6·R² texels, ordered by face, then row, then column. The faces are +x, −x, +y, −y, +z, −z in
world space. A point on a face has coordinates (s, t) in [−1, 1]. On the x faces they are (y, z), on the y faces (z, x), on the z faces (x,
y). Only this program reads these cubemaps, so they need not follow the convention of a file format.
"""

import itertools
import math
from functools import lru_cache

import torch
from torch import Tensor

SYMMETRIES = 24  # of the cube: all changes of the axes' signs, times all cyclic orders


def _face_direction(face: Tensor, s: Tensor, t: Tensor) -> Tensor:
    """Return the unnormalised direction from the cube's centre to (s, t) on a face."""
    face, s, t = torch.broadcast_tensors(face, s, t)
    axis, sign = face // 2, (1 - 2 * (face % 2)).to(s.dtype)
    direction = torch.stack([sign, s, t], dim=-1)  # along the face's axis and the two that follow it
    place = (torch.arange(3) - axis[..., None]) % 3
    direction = direction.gather(-1, place)
    return direction


def face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the points where directions (..., 3) meet the cube. Returns three tensors (...): the face, 0..5, and s and t on it, in [−1, 1].

    s and t are differentiable. A direction of length zero gives face 0 and s = t = 0.
    """
    x, y, z = directions.unbind(-1)
    with torch.no_grad():
        ax, ay, az = x.abs(), y.abs(), z.abs()
        on_x, on_y = (ax >= ay) & (ax >= az), ay >= az
    major = torch.where(on_x, x, torch.where(on_y, y, z))
    scale = 1 / major.abs().clamp_min(1e-20)
    s = torch.where(on_x, y, torch.where(on_y, z, x)) * scale
    t = torch.where(on_x, z, torch.where(on_y, x, y)) * scale
    axis = torch.where(on_x, 0, torch.where(on_y, 1, 2))
    return 2 * axis + (major.detach() < 0), s, t


@lru_cache(maxsize=32)
def texel_directions(resolution: int) -> Tensor:
    """Return the unit directions to a cubemap's texel centres: (6·R², 3), float64."""
    centres = (torch.arange(resolution, dtype=torch.float64) + 0.5) * (2 / resolution) - 1
    face = torch.arange(6)[:, None, None]
    direction = _face_direction(face, centres[None, None, :], centres[None, :, None])
    return torch.nn.functional.normalize(direction.reshape(-1, 3), dim=-1)


@lru_cache(maxsize=32)
def texel_solid_angles(resolution: int) -> Tensor:
    """Return a cubemap's exact texel solid angles in steradians: (6·R²,), float64."""
    edges = torch.arange(resolution + 1, dtype=torch.float64) * (2 / resolution) - 1
    s, t = edges[None, :], edges[:, None]
    corner = torch.atan2(s * t, torch.sqrt(s * s + t * t + 1))  # area of the rectangle from the face's centre to (s, t)
    face = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return face.flatten().repeat(6)


@lru_cache(maxsize=32)
def orbits(resolution: int) -> Tensor:
    """List groups of 24 texels that symmetries of the cube map onto each other: texel indices (R²/4, 24), where R = `resolution` is even.

    A symmetry changes the signs of some axes (8 ways), then permutes the axes cyclically (3 ways). Each row of the result lists such a
    group, called an orbit. Its first texel lies on face +x where s, t > 0. The rows are sorted by this texel's row and column on the face.
    Each texel of the cubemap occurs once.

    Column 8·p + b holds the image of the first texel under symmetry number 8·p + b. This symmetry flips the signs of axes: of x if b has
    the bit 1, of y if it has the bit 2, of z if it has the bit 4. Then it applies p times the permutation +x → +y → +z → +x.
    """
    texel = torch.arange(6 * resolution**2).reshape(3, 2, resolution, resolution)  # axis, its sign, t, s
    for dim in (2, 4):  # count each half from the face's middle outwards; its sign is a dimension before it
        less, more = texel.chunk(2, dim=dim)
        texel = torch.stack([more, less.flip(dim)], dim=dim)
    axis, x, z, t, y, s = range(6)
    return texel.permute(t, s, axis, z, y, x).reshape(-1, SYMMETRIES)


def texels_at(directions: Tensor, side: int) -> Tensor:
    """Return the indices (P,) of the texels at directions (P, 3), of a cubemap with `side` texels a side."""
    face, s, t = face_coordinates(directions)
    column, row = (((x + 1) / 2 * side).long().clamp(0, side - 1) for x in (s, t))
    return (face * side + row) * side + column


@lru_cache(maxsize=4)
def texels_in(side: int, coarse: int, device: torch.device) -> Tensor:
    """Return for each texel (6·side²,) of a cubemap the index of the texel around it, of a cubemap with `coarse` texels a side."""
    return texels_at(texel_directions(side), coarse).to(device)


@lru_cache(maxsize=8)
def orbit_order(sides: tuple[int, ...]) -> Tensor:
    """Return the indices (Σ 6·side²,) that sort the texels of stacked cubemaps by orbits.

    An orbit is a group of 24 texels that symmetries of the cube map onto each other; each row of `orbits` lists one. Use the indices as
    `levels[orbit_order(sides)]`. Afterwards the 24 texels of an orbit are adjacent. The order of the cubemaps in the stack does not change.
    """
    starts = itertools.accumulate((6 * side * side for side in sides), initial=0)
    return torch.cat([orbits(side).flatten() + start for side, start in zip(sides, starts, strict=False)])


def in_texel_order(levels: Tensor, sides: tuple[int, ...]) -> Tensor:
    """Reorder stacked cubemaps (Σ 6·side², C) from orbit order to face, row, column."""
    return levels[_texel_order(sides)]


@lru_cache
def _texel_order(sides: tuple[int, ...]) -> Tensor:
    return orbit_order(sides).argsort()


@lru_cache(maxsize=1)
def compositions() -> Tensor:
    """Tabulate which symmetry results from applying two of the cube's 24 symmetries one after the other: (24, 24).

    Entry [a, b] is the number of the symmetry that applies a first, then b. Symmetries are numbered as the columns of `orbits`.
    """
    first, then = torch.arange(SYMMETRIES)[:, None], torch.arange(SYMMETRIES)
    turn, signs = first // 8, then % 8
    signs = signs >> turn | signs << 3 - turn  # D P^turn = P^turn D', where P^turn takes the axes of D' to those of D
    return (turn + then // 8) % 3 * 8 + ((signs ^ first) & 7)


@lru_cache(maxsize=32)
def _padded_texels(resolution: int) -> Tensor:
    """Return texel indices (6, R+2, R+2) of the faces, bordered by their neighbours' texels."""
    # With the border, bilinear look-up has no seams.
    centres = (torch.arange(-1, resolution + 1, dtype=torch.float64) + 0.5) * (2 / resolution) - 1
    face = torch.arange(6)[:, None, None]
    inside = centres.clamp(-1, 1)
    # Find cells beyond the edge by their direction: a point just outside one face is just inside its neighbour.
    direction = _face_direction(face, centres[None, None, :], centres[None, :, None])
    neighbour, s, t = face_coordinates(direction)
    column = ((s + 1) * (resolution / 2)).floor().long().clamp(0, resolution - 1)
    row = ((t + 1) * (resolution / 2)).floor().long().clamp(0, resolution - 1)
    index = (neighbour * resolution + row) * resolution + column
    # Three faces meet at a corner, so there is no fourth texel: repeat the face's own.
    own_row = ((inside + 1) * (resolution / 2)).floor().long().clamp(0, resolution - 1)
    own = (face * resolution + own_row[None, :, None]) * resolution + own_row[None, None, :]
    for i in (0, -1):
        for j in (0, -1):
            index[:, i, j] = own[:, i, j]
    return index


@lru_cache(maxsize=8)
def padded(sides: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Build look-up tables for stacked cubemaps whose faces get a border one texel wide, so that bilinear look-up has no seams.

    Returns three tensors:

    - for each cell of the faces with borders, the index of its texel in the stack, (Σ 6·(side + 2)²,)
    - for each cubemap, the index of its first cell
    - for each cubemap, its side in texels
    """
    indices, starts, texels = [], [], 0
    for side in sides:
        starts.append(sum(len(i) for i in indices))
        indices.append(_padded_texels(side).flatten() + texels)
        texels += 6 * side * side
    return torch.cat(indices), torch.tensor(starts), torch.tensor(sides)


def _bilinear(face: Tensor, s: Tensor, t: Tensor, level: Tensor, sides: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    table, starts, all_sides = padded(sides)
    side = all_sides[level]
    half = side.to(s.dtype) / 2
    x = (s + 1) * half + 0.5  # in cells of the padded face
    y = (t + 1) * half + 0.5
    column = torch.minimum(x.detach().floor().long().clamp_min(0), side)
    row = torch.minimum(y.detach().floor().long().clamp_min(0), side)
    fx, fy = x - column, y - row
    width = side + 2
    corner = starts[level] + (face * width + row) * width + column
    corners = torch.stack([corner, corner + 1, corner + width, corner + width + 1], dim=-1)
    gx, gy = 1 - fx, 1 - fy
    return table[corners], torch.stack([gx * gy, fx * gy, gx * fy, fx * fy], dim=-1)


def reduced(texels: Tensor, side: int) -> Tensor:
    """Average blocks of a cubemap's texels (6·R², C) to `side` texels along a side."""
    fine = math.isqrt(len(texels) // 6) // side
    return texels.reshape(6, side, fine, side, fine, -1).mean(dim=(2, 4)).reshape(6 * side * side, -1)


def sample(levels: Tensor, sides: tuple[int, ...], directions: Tensor, level: Tensor) -> Tensor:
    """Look up values (P, 3) in stacked cubemaps, such as mip levels: bilinearly in each cubemap, linearly between two cubemaps.

    `levels` (Σ 6·side², 3) are the texels. `directions` (P, 3) need not be normalised. `level` (P,) is the cubemap's index in the stack,
    and may be fractional. Differentiable in `levels`, `directions` and `level`.
    """
    face, s, t = face_coordinates(directions)
    lower = level.detach().floor().long().clamp(0, max(len(sides) - 2, 0))
    texels, weights = _bilinear(face, s, t, lower, sides)
    if len(sides) > 1:
        fraction = (level - lower)[:, None]
        above, above_weights = _bilinear(face, s, t, lower + 1, sides)
        texels = torch.cat([texels, above], dim=-1)
        weights = torch.cat([weights * (1 - fraction), above_weights * fraction], dim=-1)
    return torch.einsum("pj,pjc->pc", weights, levels[texels])
