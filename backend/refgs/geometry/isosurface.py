"""The zero surface of distances that are known in blocks about it."""

import numpy as np
from skimage.measure import marching_cubes

from refgs.formats.mesh import Mesh

BLOCK = 4  # voxels along a block's side
_CHUNK = 16  # blocks along the side of what marching cubes takes at a time: 1 MB


def isosurface(block: np.ndarray, signed: np.ndarray) -> Mesh:
    """Marching cubes (Lewiner et al. 2003) over blocks (M, 3), each once, of BLOCK³ voxels with distances (M, BLOCK³), not finite where
    they are not known.

    Vertices are in voxels, zero at the centre of the first voxel of the block (0, 0, 0). Only cells whose eight corners are known have
    faces. Memory follows the blocks and not the space that they span: chunks are meshed one by one, each with one layer of its
    neighbours' voxels, and what two of them have in common is joined.
    """
    rows, chunks = _in_chunks(block)
    order = np.lexsort(chunks.T)
    rows, chunks = rows[order], chunks[order]
    first = np.flatnonzero(np.r_[True, (chunks[1:] != chunks[:-1]).any(axis=1)]) if len(rows) else np.zeros(0, int)
    vertices, faces, count = [], [], 0
    for part in np.split(np.arange(len(rows)), first[1:]) if len(rows) else ():
        chunk = chunks[part[0]]
        found = _mesh(block[rows[part]] - _CHUNK * chunk, signed[rows[part]])
        if found is not None:
            vertices.append(found[0] + float(BLOCK * _CHUNK) * chunk)
            faces.append(found[1] + count)
            count += len(found[0])
    if not vertices:
        return Mesh.empty()
    return _joined(np.concatenate(vertices), np.concatenate(faces))


def _in_chunks(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of blocks, and the chunks (K, 3) that they are looked at in: their own, and those before, whose last cells reach into
    them."""
    rows, chunks = [], []
    for back in np.ndindex(2, 2, 2):
        row = np.flatnonzero((block % _CHUNK == 0)[:, np.array(back, bool)].all(axis=1))
        rows.append(row)
        chunks.append(block[row] // _CHUNK - back)
    return np.concatenate(rows), np.concatenate(chunks)


def _mesh(block: np.ndarray, signed: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices, exact in the chunk's frame, and faces of one chunk; `block` counts from its corner."""
    side = _CHUNK + 1
    grid = np.full((side * BLOCK,) * 3, np.nan, np.float32)
    grid.reshape((side, BLOCK) * 3).transpose(0, 2, 4, 1, 3, 5)[tuple(block.T)] = signed.reshape(
        -1, BLOCK, BLOCK, BLOCK
    )
    end = _CHUNK * BLOCK + 1
    grid = grid[:end, :end, :end]
    known = np.isfinite(grid)
    grid[~known] = 1
    # Marching cubes visits a cell where its last corner is in the mask.
    for axis in range(3):
        known[(slice(None),) * axis + (slice(1, None),)] &= known[(slice(None),) * axis + (slice(-1),)].copy()
        known[(slice(None),) * axis + (0,)] = False
    if not known.any() or not grid.min() < 0 < grid.max():
        return None
    try:
        vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=known)
    except RuntimeError:  # no surface in the mask
        return None
    return vertices.astype(np.float64), faces.astype(np.int64)


def _joined(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """With one vertex where chunks have the same one. They have it at the very same place: on the plane between them it is
    interpolated from the same two voxels."""
    shared = np.flatnonzero((vertices % (BLOCK * _CHUNK) == 0).any(axis=1))
    _, kept, which = np.unique(vertices[shared], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[shared] = shared[kept][which.reshape(-1)]
    used, faces = np.unique(target[faces], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3))
