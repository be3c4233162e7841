"""Mesh a surface by marching cubes. The surface is given by signed distances in sparse blocks of voxels."""

import numpy as np
from skimage.measure import marching_cubes

from refgs.formats.mesh import Mesh

BLOCK = 4  # voxels along a block's side
_CHUNK = 16  # blocks along the side of a chunk, which marching cubes meshes at a time: 1 MB


def isosurface(block: np.ndarray, signed: np.ndarray) -> Mesh:
    """Mesh the surface where signed distances are zero, by marching cubes (Lewiner et al. 2003).

    Distances are given in M blocks of BLOCK³ voxels. `block` (M, 3) are the blocks' integer positions, without duplicates. `signed` (M,
    BLOCK³) are the distances; NaN or infinite means unknown. A cube gets faces only if the distances at its eight corners are known. The
    mesh's unit is the voxel, and its origin is the centre of the first voxel of block (0, 0, 0).

    Blocks are meshed in chunks. Each chunk includes one layer of voxels of the next chunks, so that the meshes join. Memory grows with the
    number of blocks, not with the volume around them.
    """
    rows, chunks = _assign_to_chunks(block)
    order = np.lexsort(chunks.T)
    rows, chunks = rows[order], chunks[order]
    first = np.flatnonzero(np.r_[True, (chunks[1:] != chunks[:-1]).any(axis=1)]) if len(rows) else np.zeros(0, int)
    vertices, faces, count = [], [], 0
    for part in np.split(np.arange(len(rows)), first[1:]) if len(rows) else ():
        chunk = chunks[part[0]]
        found = _mesh_chunk(block[rows[part]] - _CHUNK * chunk, signed[rows[part]])
        if found is not None:
            vertices.append(found[0] + float(BLOCK * _CHUNK) * chunk)
            faces.append(found[1] + count)
            count += len(found[0])
    if not vertices:
        return Mesh.empty()
    return _merge_vertices(np.concatenate(vertices), np.concatenate(faces))


def _assign_to_chunks(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List which blocks each chunk needs. Returns K pairs: the index of a block (K,), and the position of a chunk that needs it (K, 3).

    A chunk needs the blocks inside it. It also needs the next layer of blocks along each axis, so that its mesh joins the next chunk's.
    So a block at the lower side of its chunk is also listed for the neighbouring chunks on that side.
    """
    rows, chunks = [], []
    for back in np.ndindex(2, 2, 2):
        row = np.flatnonzero((block % _CHUNK == 0)[:, np.array(back, bool)].all(axis=1))
        rows.append(row)
        chunks.append(block[row] // _CHUNK - back)
    return np.concatenate(rows), np.concatenate(chunks)


def _mesh_chunk(block: np.ndarray, signed: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Mesh one chunk, relative to its lower corner; None if it contains no surface."""
    side = _CHUNK + 1
    grid = np.full((side * BLOCK,) * 3, np.nan, np.float32)
    grid.reshape((side, BLOCK) * 3).transpose(0, 2, 4, 1, 3, 5)[tuple(block.T)] = signed.reshape(
        -1, BLOCK, BLOCK, BLOCK
    )
    end = _CHUNK * BLOCK + 1
    grid = grid[:end, :end, :end]
    known = np.isfinite(grid)
    grid[~known] = 1
    # Mark the cells with eight known corners: marching cubes visits a cell if its last corner is in the mask.
    for axis in range(3):
        known[(slice(None),) * axis + (slice(1, None),)] &= known[(slice(None),) * axis + (slice(-1),)].copy()
        known[(slice(None),) * axis + (0,)] = False
    if not known.any() or not grid.min() < 0 < grid.max():
        return None
    try:
        vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=known)
    except RuntimeError:  # the mask has no surface
        return None
    return vertices.astype(np.float64), faces.astype(np.int64)


def _merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Merge the equal vertices that neighbouring chunks have in common."""
    shared = np.flatnonzero((vertices % (BLOCK * _CHUNK) == 0).any(axis=1))
    _, kept, which = np.unique(vertices[shared], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[shared] = shared[kept][which.reshape(-1)]
    used, faces = np.unique(target[faces], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3))
